"""Derivatives of a solved problem's forms, supports and conditions by their data."""
