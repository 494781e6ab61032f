"""Checks of meshes, bodies and elements before anything is computed."""
