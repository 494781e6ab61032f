"""Segment-based dual mortar conditions between two surfaces.

Facets, clipping, cells, integrals and matrices are those of one rank; conditions and pairing are of
distributed surfaces.
"""
