"""The directives `gallery` and `cards`: demos, each with its first picture and sentence."""

from __future__ import annotations

import ast
import re
import struct

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
    # of bodies in a wide picture a card shows the bodies alone, without title and colour bar
    drawn = re.search(rf"draw(_deformed)?\(\s*results / f?\"({name}|{{name}})\.png", source)
    width, height = struct.unpack(">II", picture.read_bytes()[16:24])
    kind = ["   :class-img-top: bodies"] if drawn and width > 1.5 * height else []
    return [
        f".. grid-item-card:: {title}",
        f"   :link: /demos/{name}",
        "   :link-type: doc",
        f"   :img-top: /runs/{name}/{picture.name}",
        *kind,
        "",
        f"   {docstring.splitlines()[0]}",
        "",
    ]


def grid(names: list[str]) -> list[str]:
    """Return the lines of a grid with the cards of some demos."""
    lines = [".. grid:: 1 2 3 3", "   :gutter: 2", ""]
    return lines + [f"   {line}" for name in names for line in card(name)]


def toctree(names: list[str]) -> list[str]:
    """Return the lines of a hidden table of contents with the pages of some demos."""
    return [".. toctree::", "   :hidden:", "", *(f"   /demos/{name}" for name in names), ""]


class Cards(SphinxDirective):
    """Cards for the demos named in the argument."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Return the nodes of a grid."""
        return self._parsed(grid(self.arguments[0].split()))

    def _parsed(self, lines: list[str]) -> list[nodes.Node]:
        return self.parse_text_to_nodes(StringList(lines, source=self.get_source_info()[0]))


class Gallery(Cards):
    """Cards for the demos named in the argument, and their entries in the table of contents."""

    def run(self) -> list[nodes.Node]:
        """Return the nodes of a hidden toctree and a grid."""
        names = self.arguments[0].split()
        return self._parsed([*toctree(names), *grid(names)])


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directives."""
    app.add_directive("cards", Cards)
    app.add_directive("gallery", Gallery)
    return {"parallel_read_safe": True}
