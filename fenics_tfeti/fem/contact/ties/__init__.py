"""Surfaces and degrees of freedom that stay together: ties, periodic pairs, bolts, any rows."""
