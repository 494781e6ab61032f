"""From a mesh and forms to the matrices and loads of torn subdomains."""
