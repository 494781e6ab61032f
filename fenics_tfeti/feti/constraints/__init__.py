"""Gluing, Dirichlet and contact rows B, and the layout of their multipliers over the ranks."""
