"""Configuration of Sphinx."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

here = Path(__file__).parent
sys.path.insert(0, str(here))

import inventories
import literate
from numpydoc.xref import DEFAULT_LINKS

literate.make_pages()

project = "fenics_tfeti"
author = "the fenics_tfeti authors"
release = tomllib.loads((here.parent / "pyproject.toml").read_text())["project"]["version"]
version = release
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "numpydoc",
    "myst_parser",
    "sphinx_design",
    "sphinx_copybutton",
    "gallery",
    "reference",
]
# the pages are those of `reference`
autosummary_generate = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
html_theme = "furo"
html_show_copyright = False
html_title = f"fenics_tfeti {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
autodoc_typehints = "none"
numpydoc_show_class_members = False
# types in lists of parameters are links where they are classes of dolfinx or ufl; the types of
# Python and NumPy, which numpydoc would link, stay as they are
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = {name: name for name in DEFAULT_LINKS} | inventories.types()
intersphinx_mapping = inventories.write(here / "_generated")
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "_generated"]
