"""Rigid bodies among the subdomains: their frames, and the nodes of the mesh that they move."""
