"""Links to the documentation of dolfinx and ufl, from inventories that need no network.

Intersphinx would load an inventory from each site. These have the names that the pages refer to.
"""

from __future__ import annotations

import zlib
from pathlib import Path

SITES = {
    "dolfinx": "https://docs.fenicsproject.org/dolfinx/main/python/",
    "ufl": "https://docs.fenicsproject.org/ufl/main/",
}
PAGES = {
    "dolfinx": "generated/{module}.html#$",
    "ufl": "api-doc/ufl.html#$",
}
CLASSES = {
    "dolfinx": (
        "dolfinx.fem.Constant",
        "dolfinx.fem.DirichletBC",
        "dolfinx.fem.Function",
        "dolfinx.fem.FunctionSpace",
        "dolfinx.fem.petsc.LinearProblem",
        "dolfinx.fem.petsc.NonlinearProblem",
        "dolfinx.mesh.Mesh",
        "dolfinx.mesh.MeshTags",
    ),
    "ufl": ("ufl.Form",),
}
FUNCTIONS = {"dolfinx": ("dolfinx.mesh.meshtags",), "ufl": ()}


def write(folder: Path) -> dict[str, tuple[str, str]]:
    """Write the inventories, and return what `intersphinx_mapping` says of them."""
    folder.mkdir(parents=True, exist_ok=True)
    mapping = {}
    for project, site in SITES.items():
        lines = [
            f"{name} py:{role} 1 {PAGES[project].format(module=name.rpartition('.')[0])} -\n"
            for role, names in (("class", CLASSES[project]), ("function", FUNCTIONS[project]))
            for name in names
        ]
        head = (
            "# Sphinx inventory version 2\n"
            f"# Project: {project}\n"
            "# Version: main\n"
            "# The remainder of this file is compressed using zlib.\n"
        )
        file = folder / f"{project}.inv"
        file.write_bytes(head.encode() + zlib.compress("".join(lines).encode()))
        mapping[project] = site, str(file)
    return mapping


def types() -> dict[str, str]:
    """Return the links of types in lists of parameters, by whole and by short names."""
    names = [name for classes in CLASSES.values() for name in classes]
    short = {name.rpartition(".")[2]: f":class:`~{name}`" for name in names}
    return {name: f":class:`{name}`" for name in names} | short
