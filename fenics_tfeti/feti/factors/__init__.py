"""Sparse Cholesky and LDL' factors, by packages and by solves that are compiled."""
