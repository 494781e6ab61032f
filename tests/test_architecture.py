"""The house of docs/house.rst: who may import what."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "fenics_tfeti"
FINITE_ELEMENTS = {"dolfinx", "ufl", "basix", "ffcx"}


def imports(file: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


@pytest.mark.parametrize("file", sorted(PACKAGE.glob("feti/*.py")), ids=lambda f: f.name)
def test_feti_looks_down_only(file):
    assert not {name.split(".")[0] for name in imports(file)} & FINITE_ELEMENTS
    assert not [n for n in imports(file) if n.startswith(("fenics_tfeti.fem", "fenics_tfeti.pro"))]


@pytest.mark.parametrize("file", sorted(PACKAGE.glob("qp/*.py")), ids=lambda f: f.name)
def test_qp_knows_nothing_but_numpy(file):
    outside = {name.split(".")[0] for name in imports(file)} & (
        FINITE_ELEMENTS | {"petsc4py", "mpi4py"}
    )
    assert not outside
    assert not [n for n in imports(file) if n.startswith("fenics_tfeti.") and ".qp" not in n]


@pytest.mark.parametrize("file", sorted(PACKAGE.rglob("*.py")), ids=lambda f: f.name)
def test_only_the_adapter_asks_for_versions(file):
    text = file.read_text()
    if file.name != "_compat.py":
        assert "dolfinx.cpp" not in text
        assert "dolfinx.__version__" not in text
        assert "import cpp" not in text


def test_lower_layers_need_no_dolfinx():
    code = (
        "import sys; sys.modules['dolfinx'] = sys.modules['ufl'] = None\n"
        "import fenics_tfeti.feti, fenics_tfeti.qp\n"
        "try:\n    from fenics_tfeti import ContactProblem\n"
        "except ImportError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "apt install python3-dolfinx-real" in done.stdout


@pytest.mark.parametrize(
    "first",
    [
        "from fenics_tfeti import ContactProblem",
        "import fenics_tfeti.feti",
        "import fenics_tfeti.fem.io.fields",
    ],
)
def test_package_may_be_the_first_import(first):
    """Of the wheels, mpi4py has to be imported before petsc4py and dolfinx."""
    subprocess.run([sys.executable, "-c", first], check=True)
