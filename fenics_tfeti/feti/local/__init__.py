"""Operators of one subdomain: rigid body modes, fixing nodes, generalized inverse."""
