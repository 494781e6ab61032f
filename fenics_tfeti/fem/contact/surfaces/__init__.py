"""Surfaces: tagged facets of the mesh, gathered and deformed ones, normals, gaps and areas."""
