"""The directive `gallery`: demos as cards, each with its first picture and sentence."""

from __future__ import annotations

import ast

import literate
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


def card(name: str) -> list[str]:
    """Return the lines of a demo's card in a grid."""
    source = (literate.DEMOS / f"{name}.py").read_text()
    docstring = ast.get_docstring(ast.parse(source)) or ""
    title = next(line[2:] for line in docstring.splitlines() if line.startswith("# "))
    picture = min((literate.RUNS / name).glob("*.png"))
    return [
        f".. grid-item-card:: {title}",
        f"   :link: /demos/{name}",
        "   :link-type: doc",
        f"   :img-top: /runs/{name}/{picture.name}",
        "",
        f"   {docstring.splitlines()[0]}",
        "",
    ]


class Gallery(SphinxDirective):
    """Cards for the demos named in the content, and their entries in the table of contents."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the nodes of a hidden toctree and a grid."""
        names = " ".join(self.content).split()
        lines = [".. toctree::", "   :hidden:", "", *(f"   /demos/{name}" for name in names), ""]
        lines += [".. grid:: 1 2 3 3", "   :gutter: 2", ""]
        lines += [f"   {line}" for name in names for line in card(name)]
        return self.parse_text_to_nodes(StringList(lines, source=self.get_source_info()[0]))


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directive."""
    app.add_directive("gallery", Gallery)
    return {"parallel_read_safe": True}
