"""Facets, their intersections and integrals, in NumPy alone: no ranks, no mesh of dolfinx."""
