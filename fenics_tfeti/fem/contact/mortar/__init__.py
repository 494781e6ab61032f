"""Segment-based dual mortar integrals between two faceted surfaces; NumPy and SciPy alone."""
