"""A page for each class and function that `api.rst` lists; the list becomes tables of links."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the tests of the pages need no Sphinx
    from sphinx.application import Sphinx

PAGES = Path(__file__).parent / "reference"

# a directive of autodoc with its options, and several of them
ENTRY = re.compile(r"^\.\. auto\w+:: (\S+)\n(?:   :.*\n)*", re.MULTILINE)
LIST = re.compile(rf"(?:{ENTRY.pattern})+", re.MULTILINE)


def make_pages(source: str) -> None:
    """Write the pages of a list; those of entries that are gone are removed."""
    PAGES.mkdir(exist_ok=True)
    pages = {f"{entry[1]}.rst": entry[0] for entry in ENTRY.finditer(source)}
    for page in PAGES.glob("*.rst"):
        if page.name not in pages:
            page.unlink()
    for name, directive in pages.items():
        title = name.removesuffix(".rst").rpartition(".")[2]
        text = f"{title}\n{'=' * len(title)}\n\n{directive}"
        page = PAGES / name
        # unchanged pages are not built anew
        if not page.exists() or page.read_text() != text:
            page.write_text(text)


def tables(source: str) -> str:
    """Return a list with tables of links in place of the entries."""

    def table(match: re.Match[str]) -> str:
        names = [entry[1] for entry in ENTRY.finditer(match[0])]
        lines = [".. autosummary::", "   :nosignatures:", "", *(f"   {name}" for name in names)]
        lines += ["", ".. toctree::", "   :hidden:", "", *(f"   reference/{n}" for n in names)]
        return "\n".join(lines) + "\n"

    return LIST.sub(table, source)


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages, and change the list when it is read."""

    def read(app: Sphinx, name: str, content: list[str]) -> None:
        if name == "api":
            content[0] = tables(content[0])

    make_pages((Path(app.srcdir) / "api.rst").read_text())
    app.connect("source-read", read)
    return {"parallel_read_safe": True}
