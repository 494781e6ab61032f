"""Structured meshes of boxes, each a body of its own, and tags of facets by their place."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.mesh import Mesh, locate_entities_boundary

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.geometry.reference_cells import MESH_CELLS, ReferenceCell, reference_cell
from fenics_tfeti.fem.io.tagged_mesh import Names, TaggedMesh, sorted_tags
from fenics_tfeti.fem.topology import cells_of_facets, with_tag_names
from fenics_tfeti.fem.user_data import evaluate
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

Marker = Callable[[Vector], Mask]


@dataclass(frozen=True)
class Box:
    """A box or rectangle with edges along the axes, and its grid.

    Attributes
    ----------
    lower, upper : sequence of float
        Opposite corners [m], `lower` smaller in each coordinate; two coordinates for a rectangle.
    divisions : sequence of int
        Number of grid intervals along each axis.
    name : str, optional
        Name of the body.

    Examples
    --------
    >>> Box((0, 0, 0), (2, 1, 1), divisions=(4, 2, 2), name="beam").upper
    (2, 1, 1)
    """

    lower: Sequence[float]
    upper: Sequence[float]
    divisions: Sequence[int]
    name: str = ""


def boxes(comm: MPI.Comm, bodies: Sequence[Box], cell: str = "hexahedron") -> TaggedMesh:
    """Create a mesh of boxes that share no nodes. Collective.

    Boxes that touch are separate bodies, with two nodes at each place where their grids match.
    Each rank makes an equal share of the cells, then dolfinx distributes them.

    Parameters
    ----------
    comm : MPI.Comm
        Communicator of the mesh.
    bodies : sequence of Box
        The boxes: of three coordinates for hexahedra and tetrahedra (six for each block of the
        grid), of two for quadrilaterals and triangles (two for each).
    cell : str
        Type of the cells, "triangle", "quadrilateral", "tetrahedron" or "hexahedron".

    Returns
    -------
    TaggedMesh
        The tag of a cell is the number of its box, counted from 1. No facet is tagged, see
        `tag_facets`.

    Raises
    ------
    InputError
        If a box is empty or does not fit the type of the cells, or two boxes have the same name.

    Examples
    --------
    >>> lower = Box((0, 0, 0), (2, 1, 1), divisions=(4, 2, 2))
    >>> upper = Box((1, 0, 1), (3, 1, 2), divisions=(4, 2, 2))
    >>> beams = boxes(MPI.COMM_SELF, [lower, upper])
    >>> beams.mesh.geometry.x.shape[0], len(beams.cell_tags.find(2))
    (90, 16)
    """
    with raise_collectively(comm):
        _check_boxes(bodies, cell)
    cell_type = reference_cell(cell)
    cell_counts = [len(cell_type.grid_cut) * int(np.prod(body.divisions)) for body in bodies]
    node_counts = [int(np.prod(np.add(body.divisions, 1))) for body in bodies]
    first_nodes = np.cumsum([0, *node_counts])[:-1]
    cells = [
        _cells(body, cell_type, share, first_node)
        for body, first_node, share in zip(
            bodies, first_nodes, _shares(cell_counts, comm), strict=True
        )
    ]
    points = [
        _points(body, share) for body, share in zip(bodies, _shares(node_counts, comm), strict=True)
    ]
    mesh = _compat.distributed_mesh(comm, np.concatenate(cells), np.concatenate(points), cell)
    # the cells were numbered box by box
    number = mesh.topology.original_cell_index
    body_of_cell = 1 + np.searchsorted(np.cumsum(cell_counts), number, side="right")
    cell_tags = sorted_tags(mesh, mesh.topology.dim, np.arange(len(number)), body_of_cell)
    facet_tags = sorted_tags(mesh, mesh.topology.dim - 1, np.arange(0), np.arange(0))
    names = {body.name: k for k, body in enumerate(bodies, start=1) if body.name}
    with_tag_names(cell_tags, {tag: name for name, tag in names.items()})
    return TaggedMesh(mesh, cell_tags, facet_tags, Names(names))


def tag_facets(
    mesh: Mesh,
    markers: Mapping[int, Marker] | Iterable[tuple[int, Marker] | tuple[int, Marker, int]],
    cell_tags: Any = None,
) -> Any:
    """Tag the exterior facets at the places that markers select. Collective.

    Parameters
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh.
    markers : dict of int to callable, or sequence of (tag, callable) or (tag, callable, body)
        The callable gets points (3, n) [m] and returns (n,) bool; a facet is tagged if all its
        vertices are selected. With a `body`, only the facets of cells with this tag are tagged:
        where two bodies touch, the facets of both are at the same place.
    cell_tags : dolfinx.mesh.MeshTags, optional
        The bodies; needed if `markers` name one.

    Returns
    -------
    dolfinx.mesh.MeshTags
        Tags of facets that this rank owns.

    Raises
    ------
    InputError
        If a marker selects no facet, two tags are for one facet, or a marker fails. Raised on all
        ranks.

    Examples
    --------
    >>> beams = boxes(
    ...     MPI.COMM_SELF,
    ...     [Box((0, 0, 0), (2, 1, 1), (2, 1, 1)), Box((1, 0, 1), (3, 1, 2), (2, 1, 1))],
    ... )
    >>> def contact(x):
    ...     return np.isclose(x[2], 1.0)
    >>> tags = tag_facets(beams.mesh, [(5, contact, 2), (6, contact, 1)], beams.cell_tags)
    >>> len(tags.find(5)), len(tags.find(6))
    (2, 2)
    """
    rows = list(markers.items()) if isinstance(markers, Mapping) else list(markers)
    dim = mesh.topology.dim
    mesh.topology.create_connectivity(dim - 1, dim)
    with raise_collectively(mesh.comm):
        if cell_tags is None and any(len(row) > 2 for row in rows):
            raise InputError("a facet tag is for one body only: pass the cell_tags as well")
        facets = [_selected(mesh, cell_tags, *row) for row in rows]
        tags, counts = np.array([row[0] for row in rows]), [part.size for part in facets]
        pairs = np.unique(
            np.stack([np.concatenate([*facets, []]), np.repeat(tags, counts)]), axis=1
        )
        tagged, values = pairs.astype(np.int64)
        several = np.flatnonzero(tagged[1:] == tagged[:-1])
        if several.size:
            raise InputError(
                f"{np.unique(tagged[several]).size} facets are selected for several tags, "
                f"{values[several[0]]} and {values[several[0] + 1]} for example, but a facet can "
                "have only one: make the markers disjoint"
            )
    total = mesh.comm.allreduce(np.array(counts))
    if not np.all(total):
        raise InputError(
            f"no facet of the surface is selected for the facet tags {tags[total == 0].tolist()}; "
            "check their markers (they need a tolerance, as in numpy.isclose) and bodies"
        )
    return sorted_tags(mesh, dim - 1, tagged, values)


def _check_boxes(bodies: Sequence[Box], cell: str) -> None:
    if cell not in MESH_CELLS:
        raise InputError(f"unknown cell '{cell}'; choose one of {', '.join(MESH_CELLS)}")
    if not bodies:
        raise InputError("a mesh needs at least one box")
    gdim = reference_cell(cell).dim
    for body in bodies:
        lengths = {len(body.lower), len(body.upper), len(body.divisions)}
        if lengths != {gdim}:
            raise InputError(
                f"{body} has corners or divisions of {sorted(lengths)} components; a mesh of "
                f"{cell} cells needs {gdim}"
            )
        if not np.all(np.asarray(body.lower) < np.asarray(body.upper)):
            raise InputError(
                f"{body} is empty: each component of lower has to be less than that of upper"
            )
        if any(int(n) != n or n < 1 for n in body.divisions):
            raise InputError(f"{body}: the divisions have to be whole numbers of at least 1")
    names = [body.name for body in bodies if body.name]
    if len(set(names)) < len(names):
        raise InputError(f"two boxes have the same name, out of {names}; rename one")


def _shares(counts: list[int], comm: MPI.Comm) -> list[Numbers]:
    """Return which items of each box, numbered box by box, this rank makes: equal shares."""
    total = sum(counts)
    start, stop = total * comm.rank // comm.size, total * (comm.rank + 1) // comm.size
    return [
        np.arange(max(start, first), min(stop, first + count)) - first
        for first, count in zip(np.cumsum([0, *counts]), counts, strict=False)
    ]


def _points(box: Box, nodes: Numbers) -> Vector:
    """Return the coordinates (n, gdim) of chosen nodes of a box."""
    axes = [
        np.linspace(start, stop, n + 1)
        for start, stop, n in zip(box.lower, box.upper, box.divisions, strict=True)
    ]
    places = np.unravel_index(nodes, [len(axis) for axis in axes], order="F")
    return np.column_stack([axis[i] for axis, i in zip(axes, places, strict=True)])


def _cells(box: Box, cell: ReferenceCell, cells: Numbers, first_node: int) -> Numbers:
    """Return the nodes (m, v) of chosen cells of a box, which are numbered within the box."""
    gdim = len(box.divisions)
    strides = np.cumprod([1, *np.add(box.divisions, 1)])[:gdim]
    corners = (np.arange(2**gdim)[:, np.newaxis] >> np.arange(gdim) & 1) @ strides
    block, piece = np.divmod(cells, len(cell.grid_cut))
    lowest = np.column_stack(np.unravel_index(block, box.divisions, order="F")) @ strides
    vertices: Numbers = corners[np.asarray(cell.grid_cut)][piece]
    vertices += first_node + lowest[:, np.newaxis]
    return vertices


def _selected(
    mesh: Mesh, cell_tags: Any, tag: int, marker: Marker, body: int | None = None
) -> Indices:
    """Return the exterior facets at whose vertices a marker is true, of one body or all."""
    what, dim = f"the marker of facet tag {tag}", mesh.topology.dim

    def checked(x: Vector) -> Mask:
        selected = np.asarray(evaluate(marker, x.T, what), dtype=bool)
        if selected.shape != x.shape[1:]:
            raise InputError(
                f"{what} returned the shape {selected.shape} for points of shape {x.shape}; "
                f"expected one truth value for each point, ({x.shape[1]},)"
            )
        return selected

    facets: Indices = locate_entities_boundary(mesh, dim - 1, checked)
    if body is None:
        return facets
    return facets[np.isin(cells_of_facets(mesh, facets)[0], cell_tags.find(body))]
