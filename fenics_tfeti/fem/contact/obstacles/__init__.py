"""Rigid obstacles: their shapes, their conditions, and bodies that move with them."""
