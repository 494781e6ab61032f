"""Mesh files, structured meshes, files of fields, pictures; public as `fenics_tfeti.io`."""
