"""From a mesh and forms to torn subdomains."""
