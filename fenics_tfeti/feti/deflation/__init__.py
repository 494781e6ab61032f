"""Deflation: directions in which the dual operator is large or negative, found and taken out."""
