"""Configuration of Sphinx."""

from __future__ import annotations

project = "fenics_tfeti"
author = "the fenics_tfeti authors"
extensions = ["sphinx.ext.autodoc", "sphinx.ext.mathjax", "numpydoc"]
html_theme = "furo"
autodoc_typehints = "none"
numpydoc_show_class_members = False
exclude_patterns = ["_build"]
