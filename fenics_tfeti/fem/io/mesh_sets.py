"""Meshes with named sets of nodes, elements and facets, as preprocessors write them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.geometry.reference_cells import MESH_CELLS, reference_cell
from fenics_tfeti.fem.io.gmsh import check_distinct_cells
from fenics_tfeti.fem.io.tagged_mesh import WholeMesh, tags_by_corners
from fenics_tfeti.fem.topology import distinct_rows
from fenics_tfeti.parallel import positions
from fenics_tfeti.typing import Mask, Numbers, Vector

_log = logging.getLogger(__name__)

# a name, or a number that is its own tag
Key: TypeAlias = str | int

# Kinds of elements by meshio's names: the cell and the degree.
KINDS = {
    "vertex": ("point", 1),
    "line": ("interval", 1),
    "line3": ("interval", 2),
    "triangle": ("triangle", 1),
    "triangle6": ("triangle", 2),
    "quad": ("quadrilateral", 1),
    "quad8": ("quadrilateral", 2),
    "quad9": ("quadrilateral", 2),
    "tetra": ("tetrahedron", 1),
    "tetra10": ("tetrahedron", 2),
    "hexahedron": ("hexahedron", 1),
    "hexahedron20": ("hexahedron", 2),
    "hexahedron27": ("hexahedron", 2),
}
_DIMENSIONS = {"point": 0, "interval": 1, "triangle": 2, "quadrilateral": 2}
# Nodes of elements are in VTK's order: the vertices one after the other around each face, here for
# each vertex of dolfinx, then the nodes in the middle of these vertices.
_VERTICES = {
    "triangle": (0, 1, 2),
    "quadrilateral": (0, 1, 3, 2),
    "tetrahedron": (0, 1, 2, 3),
    "hexahedron": (0, 1, 3, 2, 4, 5, 7, 6),
}
_EDGES_OF_HEXAHEDRON = (
    *((0, 1), (1, 2), (2, 3), (3, 0)),
    *((4, 5), (5, 6), (6, 7), (7, 4)),
    *((0, 4), (1, 5), (2, 6), (3, 7)),
)
_FACES_OF_HEXAHEDRON = (
    *((0, 3, 4, 7), (1, 2, 5, 6), (0, 1, 4, 5)),
    *((2, 3, 6, 7), (0, 1, 2, 3), (4, 5, 6, 7)),
)
_MIDDLES: dict[str, tuple[tuple[int, ...], ...]] = {
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quadrilateral": ((0, 1), (1, 2), (2, 3), (3, 0), (0, 1, 2, 3)),
    "tetrahedron": ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
    "hexahedron": (*_EDGES_OF_HEXAHEDRON, *_FACES_OF_HEXAHEDRON, tuple(range(8))),
}


@dataclass(frozen=True)
class MeshSets:
    """Nodes, elements of all kinds and dimensions, and their sets.

    Elements are numbered through the blocks. Sets of facets have the corners of each.
    """

    path: Path
    x: Vector  # (k, 3)
    blocks: Sequence[tuple[str, Numbers]]  # kind, nodes (m, n) in VTK's order
    elements: Mapping[Key, Numbers]
    nodes: Mapping[str, Numbers] = field(default_factory=dict)
    facets: Mapping[str, Numbers] = field(default_factory=dict)  # (f, t)
    tags: Mapping[str, int] = field(default_factory=dict)  # of names that have one


def whole_mesh(mesh: MeshSets, gdim: int, names: Sequence[Key] | None) -> WholeMesh:
    """Return a mesh whose tags are those of its sets: those with some names, or all.

    Sets of elements tag cells and facets, sets of nodes the facets on the boundary that have all
    corners in one.
    """
    path = mesh.path
    cell, degree, cells, is_cell = _cells(mesh, gdim)
    used, nodes = np.unique(cells, return_inverse=True)
    nodes, x = nodes.reshape(cells.shape), mesh.x[used]
    check_distinct_cells(path, nodes, x)
    nodes, x = _completed(cell, degree, nodes, x)
    nodes = nodes[:, _order(cell, degree)]
    bodies = _bodies(mesh, is_cell)
    surfaces = _surfaces(mesh, cell, nodes, used, names is None)
    if names is not None:
        bodies, surfaces = _chosen(path, bodies, surfaces, names)
    else:
        bodies = _without_whole(path, bodies, len(nodes))
    keys = dict.fromkeys([*bodies, *surfaces])
    tags = _numbers(keys, mesh.tags)
    facet_tag = _facet_tag(path, cell, nodes, surfaces, tags)
    return WholeMesh(
        cell,
        degree,
        nodes,
        x[:, :gdim],
        _cell_tag(path, bodies, tags, len(nodes)),
        facet_tag,
        {key: tags[key] for key in keys if isinstance(key, str)},
        {tags[key]: key for key in bodies if isinstance(key, str)},
    )


def _dimension(kind: str) -> int:
    return _DIMENSIONS.get(KINDS[kind][0], 3)


def _cells(mesh: MeshSets, gdim: int) -> tuple[str, int, Numbers, Mask]:
    """Return cell, degree and nodes of the elements that are cells, and which these are."""
    unknown = sorted({kind for kind, _ in mesh.blocks} - set(KINDS))
    dimension = max((_dimension(k) for k, _ in mesh.blocks if k in KINDS), default=0)
    kinds = sorted({kind for kind, _ in mesh.blocks if kind in KINDS and _dimension(kind) == gdim})
    if unknown or len(kinds) > 1:
        raise InputError(
            f"{mesh.path} has elements of the types {', '.join([*kinds, *unknown])}; supported are "
            f"meshes of one type out of {', '.join(MESH_CELLS)}, of degree 1 or 2"
        )
    if dimension != gdim:
        remedy = f"pass gdim={dimension}" if dimension > 1 else "mesh the bodies"
        raise InputError(
            f"the cells in {mesh.path} are of dimension {dimension}, but gdim is {gdim}: {remedy}"
        )
    is_cell = [np.full(len(nodes), kind == kinds[0]) for kind, nodes in mesh.blocks]
    cells = np.concatenate([nodes for kind, nodes in mesh.blocks if kind == kinds[0]])
    return *KINDS[kinds[0]], cells, np.concatenate(is_cell)


def _order(cell: str, degree: int) -> list[int]:
    """Return for each node of a cell in the order of dolfinx its place in that of VTK."""
    vertices = _VERTICES[cell]
    if degree == 1:
        return list(vertices)
    place = {frozenset(m): len(vertices) + k for k, m in enumerate(_MIDDLES[cell])}
    around = reference_cell(cell).midpoints
    return [*vertices, *(place[frozenset(vertices[v] for v in middle)] for middle in around)]


def _completed(cell: str, degree: int, nodes: Numbers, x: Vector) -> tuple[Numbers, Vector]:
    """Return cells of degree 2 with nodes in the middles of faces and cells, where these lack.

    The places are those of the serendipity elements with 8 and 20 nodes: half the sum of the four
    nodes on edges less a quarter of that of the corners, and in a hexahedron a quarter of both.
    """
    corners = len(_VERTICES[cell])
    edges = [m for m in _MIDDLES[cell] if len(m) == 2]
    if degree == 1 or cell in ("triangle", "tetrahedron") or nodes.shape[1] > corners + len(edges):
        return nodes, x
    faces = [m for m in _MIDDLES[cell] if len(m) == 4]
    numbers = [nodes[:, list(face)] for face in faces]
    on_edges = [[corners + k for k, e in enumerate(edges) if {*e} <= {*face}] for face in faces]
    middles = [
        0.5 * x[nodes[:, m]].sum(axis=1) - 0.25 * x[n].sum(axis=1)
        for n, m in zip(numbers, on_edges, strict=True)
    ]
    distinct, number = distinct_rows(np.sort(np.concatenate(numbers), axis=1))
    of_faces = np.zeros((len(distinct), x.shape[1]))
    of_faces[number] = np.concatenate(middles)
    columns = [nodes, len(x) + number.reshape(len(faces), -1).T]
    places = [x, of_faces]
    if cell == "hexahedron":
        columns.append(len(x) + len(distinct) + np.arange(len(nodes))[:, None])
        sums = [x[nodes[:, part]].sum(axis=1) for part in (slice(8, 20), slice(8))]
        places.append(0.25 * (sums[0] - sums[1]))
    return np.hstack(columns), np.vstack(places)


def _bodies(mesh: MeshSets, is_cell: Mask) -> dict[Key, Numbers]:
    """Return the cells of each set of elements that has some."""
    number = np.where(is_cell, np.cumsum(is_cell) - 1, -1)
    bodies = {key: np.unique(number[elements]) for key, elements in mesh.elements.items()}
    bodies = {key: cells[cells >= 0] for key, cells in bodies.items()}
    return {key: cells for key, cells in bodies.items() if cells.size}


def _without_whole(path: Path, bodies: dict[Key, Numbers], count: int) -> dict[Key, Numbers]:
    """Leave out sets of all cells where there are others."""
    parts = {key: cells for key, cells in bodies.items() if cells.size < count}
    if parts and len(parts) < len(bodies):
        left_out = [key for key in bodies if key not in parts]
        _log.info("%s: left out %s, which are sets of all cells", path, left_out)
        return parts
    return bodies


def _surfaces(
    mesh: MeshSets, cell: str, nodes: Numbers, used: Numbers, is_default: bool
) -> dict[Key, Numbers]:
    """Return the facets of each set that has some, as sorted corners (f, t) among the nodes.

    By default sets of nodes of the whole boundary are left out.
    """
    facet = reference_cell(cell).facet
    surfaces: dict[Key, Numbers] = {}
    corners = [
        block[:, : facet.vertices]
        if kind in KINDS and KINDS[kind][0] == facet.name
        else np.full((len(block), facet.vertices), -1)
        for kind, block in mesh.blocks
    ]
    of_elements = np.concatenate(corners)
    for key, elements in mesh.elements.items():
        surfaces[key] = of_elements[elements][(of_elements[elements] >= 0).all(axis=1)]
    surfaces.update(mesh.facets)
    rows = {key: positions(used, facets.astype(np.int64)) for key, facets in surfaces.items()}
    exterior = _exterior(cell, nodes)
    for name, chosen in mesh.nodes.items():
        marked = np.zeros(nodes.max() + 1, dtype=bool)
        among = positions(used, np.unique(chosen).astype(np.int64))
        marked[among[among >= 0]] = True
        # of a set of elements of the same name these are the nodes
        if name not in rows and not (is_default and marked[exterior].all()):
            rows[name] = exterior[marked[exterior].all(axis=1)]
    return {
        key: distinct_rows(np.sort(facets, axis=1))[0]
        for key, facets in rows.items()
        if len(facets)
    }


def _exterior(cell: str, nodes: Numbers) -> Numbers:
    """Return the facets of one cell alone, as sorted corners (f, t)."""
    facets = np.array(reference_cell(cell).facets)
    corners = np.sort(nodes[:, facets].reshape(-1, facets.shape[1]), axis=1)
    distinct, number = distinct_rows(corners)
    return distinct[np.bincount(number) == 1]


def _chosen(
    path: Path, bodies: dict[Key, Numbers], surfaces: dict[Key, Numbers], names: Sequence[Key]
) -> tuple[dict[Key, Numbers], dict[Key, Numbers]]:
    """Return the bodies and surfaces of some names."""
    missing = [name for name in names if name not in bodies and name not in surfaces]
    if missing:
        there = sorted(map(str, {**bodies, **surfaces}))
        raise InputError(
            f"{path} has no set {missing[0]!r} with cells or facets; the sets are {there}"
        )
    return (
        {name: bodies[name] for name in names if name in bodies},
        {name: surfaces[name] for name in names if name in surfaces},
    )


def _numbers(keys: Mapping[Key, None], given: Mapping[str, int]) -> dict[Key, int]:
    """Return the tags of sets: their numbers, or the next free ones."""
    tags = {
        key: given[key] if isinstance(key, str) else key
        for key in keys
        if key in given or isinstance(key, int)
    }
    taken = set(tags.values())
    free = (n for n in range(1, len(keys) + len(taken) + 1) if n not in taken)
    return {key: tags[key] if key in tags else next(free) for key in keys}


def _cell_tag(path: Path, bodies: dict[Key, Numbers], tags: dict[Key, int], count: int) -> Numbers:
    """Return the tag of each cell; all have the tag 1 where there are no sets of cells."""
    if not bodies:
        return np.ones(count, dtype=np.int64)
    owner = np.full(count, -1)
    for number, (key, cells) in enumerate(bodies.items()):
        if (again := owner[cells] >= 0).any():
            other = list(bodies)[owner[cells[again][0]]]
            raise _in_several(path, "cell", other, key)
        owner[cells] = number
    if missing := np.count_nonzero(owner < 0):
        raise InputError(
            f"{path}: {missing} of {count} cells are in none of the sets {list(bodies)}; give each "
            "body one"
        )
    return np.array([tags[key] for key in bodies])[owner]


def _facet_tag(
    path: Path, cell: str, nodes: Numbers, surfaces: dict[Key, Numbers], tags: dict[Key, int]
) -> Numbers:
    """Return the tags of the facets (m, f) of cells."""
    count = reference_cell(cell).facet.vertices
    facets = np.concatenate([np.zeros((0, count), dtype=np.int64), *surfaces.values()])
    owner = np.repeat(np.arange(len(surfaces)), [len(part) for part in surfaces.values()])
    number = distinct_rows(facets)[1]
    first = np.full(number.max(initial=-1) + 1, len(surfaces))
    np.minimum.at(first, number, owner)
    if (again := first[number] < owner).any():
        sets, k = list(surfaces), int(again.argmax())
        raise _in_several(path, "facet", sets[first[number[k]]], sets[owner[k]])
    values = np.array([tags[key] for key in surfaces], dtype=np.int64)[owner]
    facet_tag, is_facet = tags_by_corners(cell, nodes, facets, values)
    if not is_facet.all():
        wrong = list(surfaces)[owner[~is_facet][0]]
        raise InputError(
            f"{path}: {np.count_nonzero(~is_facet)} of the {len(facets)} elements in sets of "
            f"facets are not facets of cells, the first in {wrong!r}; mesh the bodies again"
        )
    return facet_tag


def _in_several(path: Path, what: str, one: Key, other: Key) -> InputError:
    return InputError(
        f"{path}: a {what} is in the sets {one!r} and {other!r}, but can have only one tag: name "
        "the sets that are to be tags, names=[...]"
    )
