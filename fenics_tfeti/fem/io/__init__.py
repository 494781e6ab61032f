"""Mesh files, structured meshes, fields in files, pictures."""
