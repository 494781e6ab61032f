"""Demos as pages and as notebooks, and the code of pages: what the documentation is made from.

A demo is a script whose docstring and paragraphs of comments are Markdown. `conf.py` makes a page
and a notebook of each before Sphinx reads the sources. The code in pages is read from them for the
tests, and the tutorial's to be downloaded.
"""

from __future__ import annotations

import ast
import re
import shutil
import textwrap
from dataclasses import dataclass
from pathlib import Path

import nbformat.v4 as notebooks

DOCS = Path(__file__).parent
DEMOS = DOCS.parent / "demos"
PAGES = DOCS / "demos"
MESHES = DOCS.parent / "meshes"
RUNS = DOCS / "runs"

# A notebook has no file name: it is run in the project's folder.
_HERE = "here = Path(__file__).parent"
_HERE_IN_NOTEBOOKS = 'here = Path("demos")'
# Jupyter has arguments of its own
_ARGUMENTS, _ARGUMENTS_IN_NOTEBOOKS = "sys.argv[1:]", "[]"


@dataclass(frozen=True)
class Cell:
    """A piece of a script or page.

    Attributes
    ----------
    kind : str
        "text" for Markdown, in pages for what a block prints; "python"; "console".
    content : str
        Without the marks of comments or fences.
    """

    kind: str
    content: str


def script_cells(source: str) -> list[Cell]:
    """Return the docstring of a script, its paragraphs of comments, and the code between them.

    A comment is text if it begins a line and blank lines are around it; other comments belong to
    the code.
    """
    tree = ast.parse(source)
    docstring, lines = ast.get_docstring(tree), ["", *source.splitlines(), ""]
    if docstring is None:
        raise ValueError("the script has no docstring")
    begin = (tree.body[0].end_lineno or 0) + 1
    cells, code = [Cell("text", docstring)], list[str]()
    while begin < len(lines):
        end = begin
        while end < len(lines) and lines[end].startswith("#"):
            end += 1
        if end > begin and not lines[begin - 1] and not lines[end]:
            cells += [
                Cell("python", "\n".join(code)),
                Cell("text", _without_marks(lines[begin:end])),
            ]
            code = []
        else:
            end = max(end, begin + 1)
            code += lines[begin:end]
        begin = end
    cells.append(Cell("python", "\n".join(code)))
    return [cell for cell in cells if cell.content.strip()]


def _without_marks(comments: list[str]) -> str:
    return "\n".join(line.removeprefix("#").removeprefix(" ") for line in comments)


def page_of(name: str, source: str) -> str:
    """Return the page of a demo in Markdown, with the output and the pictures of its last run."""
    head, *cells = script_cells(source)
    summary, title, text = re.fullmatch(r"(.*?)\n\n# (.*?)\n(.*)", head.content, re.S).groups()
    parts = [
        f"# {title}",
        summary,
        f"{{download}}`{name}.py <../../demos/{name}.py>`, as a notebook "
        f"{{download}}`{name}.ipynb <notebooks/{name}.ipynb>`",
        *_meshes_of(source),
        text.strip("\n"),
    ]
    # an animation, then the pictures
    pictures = [path for kind in ("gif", "png") for path in sorted((RUNS / name).glob(f"*.{kind}"))]
    parts += [f"![{title}: {picture.stem}](../runs/{name}/{picture.name})" for picture in pictures]
    for cell in cells:
        code = "```python\n" + cell.content.strip("\n") + "\n```"
        parts.append(cell.content if cell.kind == "text" else code)
    parts += ["## Output", f"```{{literalinclude}} ../runs/{name}/output.txt\n:language: text\n```"]
    return "\n\n".join(parts) + "\n"


def _meshes_of(source: str) -> list[str]:
    """Return a line with the files in `meshes` that a demo reads or imports; none without any."""
    # names of meshes as words, or with a part that is filled in
    patterns = re.findall(r"\"(\w+)(?:\.msh)?\"", source)
    patterns += [re.sub(r"{\w+}", "*", name) for name in re.findall(r"\"(\w+{\w+})\.msh", source)]
    found = [path for name in patterns for path in sorted(MESHES.glob(f"{name}.msh"))]
    scripts = [MESHES / name for name in re.findall(r"meshes/(\w+\.py)", source)]
    scripts += [path for path in (path.with_suffix(".py") for path in found) if path.is_file()]
    paths = dict.fromkeys([*found, *scripts, *([MESHES / "gmsh_files.py"] if scripts else [])])
    links = [f"{{download}}`{path.name} <../../meshes/{path.name}>`" for path in paths]
    where = "The script looks for its meshes in the folder `meshes` beside its own"
    return [f"{where}: {', '.join(links)}."] if links else []


def notebook_of(source: str) -> str:
    """Return a demo as a notebook of Jupyter."""
    cells = []
    for number, cell in enumerate(script_cells(source)):
        if cell.kind == "text":
            made = notebooks.new_markdown_cell(cell.content)
        else:
            code = cell.content.strip("\n").replace(_HERE, _HERE_IN_NOTEBOOKS)
            made = notebooks.new_code_cell(code.replace(_ARGUMENTS, _ARGUMENTS_IN_NOTEBOOKS))
        made["id"] = f"cell-{number}"  # random ones would change with each build
        cells.append(made)
    cells[0]["source"] += "\n\nStart this notebook in the project's folder, which has the meshes."
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = notebooks.new_notebook(cells=cells, metadata={"kernelspec": kernel})
    return notebooks.writes(notebook) + "\n"


def page_cells(page: str) -> list[Cell]:
    """Return the blocks of code of a page in Markdown or reStructuredText, in their order.

    In Markdown a fence of ``text`` right after a block of Python is what this block prints.
    """
    fences = r"^```(python|console|text)\n(.*?)^```$"
    directives = (
        r"^(?P<indent> *)\.\. code-block:: (python|console)\n\n((?:(?P=indent) +\S.*\n|\s*\n)+)"
    )
    found = [(m.start(), m[1], m[2]) for m in re.finditer(fences, page, re.M | re.S)]
    found += [(m.start(), m[2], m[3]) for m in re.finditer(directives, page, re.M)]
    return [Cell(kind, textwrap.dedent(body).strip("\n")) for _, kind, body in sorted(found)]


def script_of(page: str, name: str) -> str:
    """Return the blocks of Python of a page as a script."""
    blocks = [cell.content for cell in page_cells(page) if cell.kind == "python"]
    return (
        f'"""The code of the page {name} of the documentation."""\n\n' + "\n\n".join(blocks) + "\n"
    )


def make_pages() -> None:
    """Write the pages and notebooks of all demos, and the tutorial's script, where they changed."""
    PAGES.mkdir(exist_ok=True)
    demos = {path.stem: path.read_text() for path in sorted(DEMOS.glob("*.py"))}
    for old in PAGES.glob("*.md"):
        if old.stem not in demos:
            old.unlink()
    for name, source in demos.items():
        write_changed(PAGES / f"{name}.md", page_of(name, source))
        write_changed(PAGES / "notebooks" / f"{name}.ipynb", notebook_of(source))
    tutorial = (DOCS / "tutorial.md").read_text()
    write_changed(DOCS / "_generated" / "tutorial.py", script_of(tutorial, "Tutorial"))


def write_changed(path: Path, content: str) -> None:
    """Write a file, unless it has this content: Sphinx reads again what is newer."""
    if not path.is_file() or path.read_text() != content:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)


def clean() -> None:
    """Remove what `make_pages` writes."""
    for page in PAGES.glob("*.md"):
        page.unlink()
    for folder in (PAGES / "notebooks", DOCS / "_generated"):
        shutil.rmtree(folder, ignore_errors=True)
