"""The layers: which module may import which, and what each layer may import from outside."""

from __future__ import annotations

import ast
import functools
import graphlib
import sys
from pathlib import Path
from typing import Any

import pytest
from new_process import run_python

pytestmark = pytest.mark.once

PACKAGE = Path(__file__).parent.parent / "fenics_tfeti"
FINITE_ELEMENTS = {"dolfinx", "ufl", "basix", "ffcx"}

# What the modules of a layer may import from the other layers, and from outside at their top.
# The modules on no layer (problem, options, report) join the layers and may import all of them.
LAYERS = {
    "typing": (set(), {"numpy"}),
    "errors": (set(), set()),
    "parallel": ({"typing", "errors"}, {"mpi4py", "numpy"}),
    "compiled": ({"typing"}, set()),
    "petsc": (set(), {"petsc4py"}),
    "qp": ({"typing", "errors"}, {"numpy", "scipy"}),
    "feti": (
        {"typing", "errors", "parallel", "compiled", "petsc", "qp"},
        {"mpi4py", "numpy", "scipy"},
    ),
    "fem": ({"typing", "errors", "parallel", "compiled", "feti"}, None),
}
# The rooms of fem, files or folders: each imports those before it.
FEM_ORDER = [
    "tolerances",
    "messages",
    "geometry",
    "form_numbers",
    "assembly_loops",
    "_compat",
    "topology",
    "nodes",
    "displacement",
    "user_data",
    "decomposition",
    "gradients",
    "other_mesh",
    "contact.surfaces",
    "contact.descriptions",
    "checks",
    "contact.conditions",
    "contact.rigid",
    "contact.contact_set",
    "contact.search",
    "contact.solution",
    "torn_problem",
    "mesh_error",
    "io",
]
# The sub-packages of feti: each imports those before it, and of feti's own modules only these.
FETI_ORDER = [
    "factors",
    "local",
    "constraints",
    "checks",
    "coarse",
    "deflation",
    "dual",
    "solution",
    "files",
    "report",
]
FETI_BASE = {"system", "tolerances", "costs", "options", "interruption"}
# the phases of a solve, which the solution adds to and the report has, have a time each
FETI_OWN = {"solution": {"timer"}, "report": {"timer"}}


def name_of(file: Path) -> str:
    """Return the dotted name of a module."""
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {name_of(file): file for file in sorted(PACKAGE.rglob("*.py"))}
MODULES = sorted(FILES)


@functools.cache
def tree_of(module: str) -> ast.Module:
    return ast.parse(FILES[module].read_text())


def in_layer(layer: str) -> list[str]:
    """Return the modules of a layer, those of its sub-packages included."""
    return [name for name in MODULES if f"{name}.".startswith(f"fenics_tfeti.{layer}.")]


def imports(tree: ast.Module, top_only: bool = False) -> set[str]:
    """Return the modules that a module imports; those of the package by their full names."""
    found = set()
    for node in tree.body if top_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full in FILES else node.module)
    return found


def source(module: str, name: str) -> str:
    """Return the module in which a name is defined that a package may only pass on."""
    for node in tree_of(module).body:
        if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}:
            return source(node.module, name) if node.module in FILES else node.module
    return module


@functools.cache
def graph() -> dict[str, set[str]]:
    """Return the modules of the package that each module imports."""
    found = {name: imports(tree_of(name)) for name in MODULES}
    return {
        name: {other for other in others if other.split(".")[0] == "fenics_tfeti"}
        for name, others in found.items()
    }


def roots(modules: set[str]) -> set[str]:
    """Return the top-level packages of modules."""
    return {module.split(".")[0] for module in modules}


def listed(wrong: list[Any]) -> str:
    """Return the message of a test: all that is wrong, a line each."""
    return "\n".join(map(str, wrong))


def test_layers_have_modules():
    """A layer that was renamed would pass all other tests."""
    empty = [layer for layer in LAYERS if not in_layer(layer)]
    empty += [package for package in FETI_ORDER if len(in_layer(f"feti.{package}")) < 2]
    assert not empty, listed(empty)


def test_imports_are_absolute():
    wrong = [
        name
        for name in MODULES
        for node in ast.walk(tree_of(name))
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    assert not wrong, listed(wrong)


def test_layers_are_imported_downwards():
    wrong = [
        (name, other)
        for layer, (allowed, _) in LAYERS.items()
        for name in in_layer(layer)
        for other in sorted(graph()[name])
        if other.split(".")[1] not in allowed | {layer}
    ]
    assert not wrong, listed(wrong)


def test_libraries_that_a_layer_needs():
    """Other libraries may be imported within functions, where they are optional."""
    always = set(sys.stdlib_module_names) | {"fenics_tfeti"}
    wrong = [
        (name, library)
        for layer, (_, outside) in LAYERS.items()
        if outside is not None
        for name in in_layer(layer)
        for library in sorted(roots(imports(tree_of(name), top_only=True)) - always - outside)
    ]
    assert not wrong, listed(wrong)


def test_only_fem_imports_finite_element_libraries():
    """The problem, the models and the self-test take or pose forms."""
    others = {
        f"fenics_tfeti.{name}"
        for name in ("problem", "nonlinear", "models", "load_steps", "tape", "__main__")
    }
    others.update(in_layer("fem") + in_layer("newton") + in_layer("sensitivities"))
    wrong = [
        name
        for name in MODULES
        if name not in others and roots(imports(tree_of(name))) & FINITE_ELEMENTS
    ]
    assert not wrong, listed(wrong)


def test_fem_knows_only_the_data_files_timer_and_tolerances_of_feti():
    """And what a solution has."""
    names = ("files.arrays", "system", "timer", "tolerances")
    solution = {"ContactForces", "TornSolution"}
    known = {f"fenics_tfeti.feti.{name}" for name in names}
    wrong = [
        (name, node.module, alias.name)
        for name in in_layer("fem")
        for node in ast.walk(tree_of(name))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fenics_tfeti.feti")
        for alias in node.names
        if source(node.module, alias.name) not in known and alias.name not in solution
    ]
    assert not wrong, listed(wrong)


def test_subpackages_of_feti_are_imported_downwards():
    wrong = [
        (name, other)
        for place, package in enumerate(FETI_ORDER)
        for name in in_layer(f"feti.{package}")
        for other in sorted(graph()[name])
        if other.startswith("fenics_tfeti.feti.")
        and other.split(".")[2]
        not in FETI_BASE | FETI_OWN.get(package, set()) | set(FETI_ORDER[: place + 1])
    ]
    assert not wrong, listed(wrong)


def room_of_fem(module: str) -> int:
    """Return the place of a module of fem in the order of its rooms; -1 of what is none of it."""
    parts = module.removeprefix("fenics_tfeti.fem.").split(".")
    names = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next((FEM_ORDER.index(name) for name in names if name in FEM_ORDER), -1)


def test_rooms_of_fem_are_imported_downwards():
    wrong = [
        (name, other)
        for name in in_layer("fem")
        for other in sorted(graph()[name])
        if other.startswith("fenics_tfeti.fem.") and room_of_fem(other) > room_of_fem(name)
    ]
    assert not wrong, listed(wrong)


def test_each_module_of_fem_has_a_room():
    packages = {"fenics_tfeti.fem", "fenics_tfeti.fem.contact"}
    without = [name for name in in_layer("fem") if room_of_fem(name) < 0 and name not in packages]
    unused = [room for room in FEM_ORDER if not in_layer(f"fem.{room}")]
    assert not without + unused, listed(without + unused)


def test_geometry_knows_neither_ranks_nor_meshes():
    libraries = {"mpi4py", "petsc4py", "dolfinx", "ufl"}
    wrong = [
        name
        for name in in_layer("fem.geometry")
        if roots(imports(tree_of(name))) & libraries
        or any("parallel" in other for other in graph()[name])
    ]
    assert not wrong, listed(wrong)


def test_no_modules_import_each_other():
    graphlib.TopologicalSorter(graph()).prepare()


def test_only_the_adapter_asks_for_versions():
    words = ("dolfinx.cpp", "import cpp", "_cpp_object", "dolfinx.__version__")
    wrong = [
        (name, word)
        for name, file in FILES.items()
        if name != "fenics_tfeti.fem._compat"
        for word in words
        if word in file.read_text()
    ]
    assert not wrong, listed(wrong)


def test_feti_needs_no_finite_element_library():
    printed = run_python(
        "import sys\n"
        f"for missing in {FINITE_ELEMENTS}: sys.modules[missing] = None\n"
        "import fenics_tfeti.feti\n"
        "try:\n    from fenics_tfeti import ContactProblem\n"
        "except ImportError as error:\n    print(error)"
    )
    assert "apt install python3-dolfinx-real" in printed


def test_qp_needs_neither_mpi_nor_petsc():
    run_python(
        "import sys\n"
        f"for missing in {FINITE_ELEMENTS | {'mpi4py', 'petsc4py'}}: sys.modules[missing] = None\n"
        "import fenics_tfeti.qp"
    )


@pytest.mark.parametrize(
    "first", ["from fenics_tfeti import ContactProblem", "import fenics_tfeti.io"]
)
def test_package_may_be_the_first_import(first):
    """Of the wheels, mpi4py has to be imported before petsc4py and dolfinx."""
    run_python(first)
