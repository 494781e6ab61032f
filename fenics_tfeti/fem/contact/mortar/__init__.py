"""Segment-based dual mortar conditions between two surfaces.

Facets, candidates, clipping, cells, integrals and matrices are those of one rank; conditions,
pairing and checks are of distributed surfaces.
"""
