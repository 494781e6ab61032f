"""Demos as pages and notebooks; the interface that they use; links between pages."""

import ast
import re
import sys
import zlib
from pathlib import Path

import inventories
import literate
import nbformat
import pytest
import reference

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tools"))
from check_links import broken_links

pytestmark = pytest.mark.once

DEMOS = sorted((ROOT / "demos").glob("*.py"))
SCRIPT = '''"""One line.

# A title

What it is about.
"""

from __future__ import annotations

# a comment on the code
x = 1  # and another

# ## A section
#
# Text of the section.

# a second paragraph


def f():
    # inside
    return 2


# that belongs to y
y = 3
'''


def test_cells_of_a_script():
    cells = literate.script_cells(SCRIPT)
    assert [cell.kind for cell in cells] == ["text", "python", "text", "text", "python"]
    assert cells[2].content == "## A section\n\nText of the section."
    assert cells[3].content == "a second paragraph"
    assert "# a comment on the code\nx = 1  # and another" in cells[1].content
    assert "# inside" in cells[4].content and "# that belongs to y\ny = 3" in cells[4].content


@pytest.mark.parametrize("demo", DEMOS, ids=lambda path: path.stem)
def test_notebooks_have_the_code_of_the_demos(demo):
    notebook = nbformat.reads(literate.notebook_of(demo.read_text()), as_version=4)
    nbformat.validate(notebook)
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    assert "__file__" not in code and "argv" not in code
    script = demo.read_text().replace("Path(__file__).parent", 'Path("demos")')
    script = script.replace("sys.argv[1:]", "[]")
    body = ast.parse(script).body[1:]  # without the docstring
    assert ast.dump(ast.Module(body, [])) == ast.dump(ast.parse(code))


@pytest.mark.parametrize("demo", DEMOS, ids=lambda path: path.stem)
def test_pages_show_text_code_output_and_pictures(demo):
    page = literate.page_of(demo.stem, demo.read_text())
    assert page.startswith("# ")
    for cell in literate.script_cells(demo.read_text())[1:]:
        assert cell.content.strip("\n") in page
    run = ROOT / "docs" / "runs" / demo.stem
    assert (run / "output.txt").read_text().strip()
    pictures = [*run.glob("*.png"), *run.glob("*.gif")]
    assert pictures
    assert all(f"](../runs/{demo.stem}/{picture.name})" in page for picture in pictures)


@pytest.mark.parametrize("demo", DEMOS, ids=lambda path: path.stem)
def test_pages_link_the_meshes_that_demos_read(demo):
    source = demo.read_text()
    page, meshes = literate.page_of(demo.stem, source), ROOT / "meshes"
    linked = re.findall(r"<\.\./\.\./meshes/([\w.]+)>", page)
    assert all((meshes / name).is_file() for name in linked)
    assert bool(linked) == (' / "meshes"' in source)
    for name in re.findall(r"(\w+\.msh)\"", source):
        assert name in linked


def test_each_demo_is_in_the_list():
    listed = (ROOT / "docs" / "demos" / "index.rst").read_text().split()
    assert {demo.stem for demo in DEMOS} <= set(listed)


@pytest.mark.parametrize("page", ["tutorial.md", "solver_alone.rst", "howto/cad_mesh.md"])
def test_code_of_pages(page):
    cells = literate.page_cells((ROOT / "docs" / page).read_text())
    code = [cell.content for cell in cells if cell.kind == "python"]
    assert len(code) > 3
    for block in code:
        ast.parse(block)


def test_the_interface_lists_what_demos_import():
    api = (ROOT / "docs" / "api.rst").read_text()
    for demo in DEMOS:
        for node in ast.walk(ast.parse(demo.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fenics_tfeti"):
                for name in node.names:
                    assert f":: {node.module}.{name.name}\n" in api, (demo.name, name.name)


def test_pages_of_the_interface(tmp_path, monkeypatch):
    """One for each entry of the list, with its options; the list has links to them."""
    source = "Bodies\n======\n\n.. autoclass:: a.B\n   :members: c\n.. autofunction:: a.d\n\nEnd\n"
    monkeypatch.setattr(reference, "PAGES", tmp_path)
    (tmp_path / "gone.rst").write_text("")
    reference.make_pages(source)
    assert sorted(page.name for page in tmp_path.iterdir()) == ["a.B.rst", "a.d.rst"]
    assert (tmp_path / "a.B.rst").read_text() == "B\n=\n\n.. autoclass:: a.B\n   :members: c\n"
    listed = reference.tables(source)
    assert "   a.B\n   a.d\n" in listed and "   reference/a.B\n   reference/a.d\n" in listed
    assert "auto" not in listed.replace("autosummary", "") and listed.endswith("\nEnd\n")


def test_links(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.html").write_text('<p id="x"></p><a href="sub/b.html#y">b</a><a href="#x">x</a>')
    (tmp_path / "sub" / "b.html").write_text('<p id="y"></p><a href="https://there.example">c</a>')
    assert broken_links(tmp_path) == []
    (tmp_path / "sub" / "b.html").write_text('<a href="../a.html#z">a</a><img src="c.png">')
    assert broken_links(tmp_path) == [
        "a.html: sub/b.html#y",
        "sub/b.html: ../a.html#z",
        "sub/b.html: c.png",
    ]


def test_inventories_have_the_pages_of_the_sites(tmp_path):
    """In the form that Sphinx reads: four lines, then a compressed line for each name."""
    site, file = inventories.write(tmp_path)["dolfinx"]
    lines = zlib.decompress(Path(file).read_bytes().split(b"\n", 4)[4]).decode().splitlines()
    assert site.startswith("https://docs.fenicsproject.org/")
    assert "dolfinx.fem.Function py:class 1 generated/dolfinx.fem.html#$ -" in lines
    assert "dolfinx.mesh.meshtags py:function 1 generated/dolfinx.mesh.html#$ -" in lines
