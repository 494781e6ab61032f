"""Checks of a torn system before anything is computed."""
