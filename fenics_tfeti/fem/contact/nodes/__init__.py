"""Conditions between pairs of nodes: the search for partners."""
