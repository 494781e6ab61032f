"""Finer meshes: marked simplices bisected, with their tags; cell sizes for Gmsh.

A marked cell has all edges bisected. In each triangle with a bisected edge the longest edge is, too
(A. Plaza and G. F. Carey, Appl. Numer. Math. 32, 2000), which bounds the angles. Each cell is cut
at its longest marked edge, then its halves are: cells that share a facet cut it alike.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError, wrong_type
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.io.gmsh import import_gmsh
from fenics_tfeti.fem.io.interfaces import gather_mesh
from fenics_tfeti.fem.io.tagged_mesh import TaggedMesh, WholeMesh, distribute
from fenics_tfeti.fem.topology import (
    NO_TAG,
    cell_type,
    cell_vertices,
    distinct_rows,
    owned_cells,
    vertex_nodes,
)
from fenics_tfeti.parallel import meet, raise_collectively
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

# the kinds of cells of a view of Gmsh with scalars at the vertices
_VIEWS = {"triangle": "ST", "quadrilateral": "SQ", "tetrahedron": "SS", "hexahedron": "SH"}


def refine(tagged: TaggedMesh, cells: Indices | None = None) -> TaggedMesh:
    """Refine triangles or tetrahedra with straight edges, with their tags and names. Collective.

    Rank 0 gathers the cells, as many as it reads from a file of Gmsh. New nodes are in the middle
    of edges: of curved surfaces make a new mesh by `MeshError.sizes` instead.

    Parameters
    ----------
    tagged : TaggedMesh
        The mesh; it stays as it is.
    cells : integer array, optional
        The cells that this rank owns and that are to be refined, as `MeshError.mark` returns them;
        all edges of these are bisected. Others are refined where their neighbours ask for it. By
        default all are refined.

    Returns
    -------
    TaggedMesh
        A new mesh, distributed anew. Parts of cells and facets have the tags of the whole.

    Raises
    ------
    InputError
        If the cells are quadrilaterals, hexahedra or curved, or numbers of cells are wrong.

    Examples
    --------
    >>> fine = refine(parts, problem.mesh_error().mark(0.5))  # doctest: +SKIP
    """
    if not isinstance(tagged, TaggedMesh):
        raise wrong_type("refine: the mesh", tagged, "a TaggedMesh")
    mesh, comm = tagged.mesh, tagged.mesh.comm
    meet(comm, "refine()")
    with raise_collectively(comm):
        _check(tagged)
        chosen = np.arange(owned_cells(mesh)) if cells is None else np.asarray(cells, dtype=int)
        if chosen.size and not 0 <= chosen.min() <= chosen.max() < owned_cells(mesh):
            raise InputError(
                f"refine: cells are numbers from 0 to {owned_cells(mesh) - 1} on rank {comm.rank}, "
                f"which owns these; got {chosen.min()} to {chosen.max()}"
            )
    marked = comm.gather(_compat.input_cells(mesh)[chosen])
    whole = gather_mesh(tagged)
    if whole is not None and marked is not None:
        whole = bisected(whole, np.isin(np.arange(len(whole.nodes)), np.concatenate(marked)))
    return distribute(comm, whole)


def _check(tagged: TaggedMesh) -> None:
    """Check that the cells can be bisected."""
    kind, degree = cell_type(tagged.mesh), _compat.geometry_degree(tagged.mesh)
    what = f"{kind.name}s" if not kind.is_simplex else "curved cells" if degree > 1 else ""
    if what:
        raise InputError(
            f"refine: {what} cannot be refined, only triangles and tetrahedra with straight edges. "
            "Make a new mesh, with the sizes of MeshError.sizes()"
        )


def bisected(whole: WholeMesh, marked: Mask) -> WholeMesh:
    """Return a mesh with the edges of marked cells bisected, and those that follow."""
    edges = np.array(whole.kind.edges)
    pairs, numbers = distinct_rows(np.sort(whole.nodes[:, edges], axis=2).reshape(-1, 2))
    of_cell = numbers.reshape(-1, len(edges))
    lengths = np.linalg.norm(np.diff(whole.x[pairs], axis=1)[:, 0], axis=1)
    # equal lengths are told apart by the numbers of edges, which all cells agree on
    rank = np.empty(len(pairs), dtype=np.int64)
    rank[np.lexsort((np.arange(len(pairs)), _rounded(lengths)))] = np.arange(len(pairs))
    is_cut = np.zeros(len(pairs), dtype=bool)
    is_cut[of_cell[marked]] = True
    triangles = _triangles(whole, of_cell)
    longest = np.take_along_axis(triangles, rank[triangles].argmax(axis=1)[:, None], 1)[:, 0]
    while True:
        follow = longest[is_cut[triangles].any(axis=1)]
        if is_cut[follow].all():
            break
        is_cut[follow] = True
    return _cut(whole, pairs, is_cut, rank)


def _rounded(lengths: Vector) -> Vector:
    """Return lengths that are equal where they differ by rounding."""
    unit = 1e-9 * lengths.max(initial=1e-300)
    return np.round(lengths / unit)


def _triangles(whole: WholeMesh, of_cell: Numbers) -> Numbers:
    """Return the edges (t, 3) of the triangles of all cells."""
    if whole.kind.dim == 2:
        return of_cell
    sides = [[e for e, ends in enumerate(whole.kind.edges) if set(ends) <= set(corners)]
             for corners in whole.kind.facets]  # fmt: skip
    return of_cell[:, np.array(sides)].reshape(-1, 3)


def _cut(whole: WholeMesh, pairs: Numbers, is_cut: Mask, rank: Numbers) -> WholeMesh:
    """Bisect cells at their longest edge that is to be cut, until there is none."""
    middle = np.full(len(pairs), -1)
    middle[is_cut] = len(whole.x) + np.arange(np.count_nonzero(is_cut))
    x = np.concatenate([whole.x, whole.x[pairs[is_cut]].mean(axis=1)])
    limit = len(x)
    keys = pairs[:, 0] * limit + pairs[:, 1]  # ascending
    edges = np.array(whole.kind.edges)
    nodes, cell_tag, facet_tag = whole.nodes, whole.cell_tag, whole.facet_tag
    done: list[tuple[Numbers, Numbers, Numbers]] = []
    while len(nodes):
        ends = np.sort(nodes[:, edges], axis=2)
        key = ends[..., 0] * limit + ends[..., 1]
        position = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        to_cut = (keys[position] == key) & is_cut[position]
        is_done = ~to_cut.any(axis=1)
        done.append((nodes[is_done], cell_tag[is_done], facet_tag[is_done]))
        nodes, cell_tag, facet_tag = nodes[~is_done], cell_tag[~is_done], facet_tag[~is_done]
        position, to_cut = position[~is_done], to_cut[~is_done]
        every = np.arange(len(nodes))
        chosen = np.where(to_cut, rank[position], -1).argmax(axis=1)
        halves = []
        for kept, replaced in ((0, 1), (1, 0)):
            half, tags = nodes.copy(), facet_tag.copy()
            half[every, edges[chosen, replaced]] = middle[position[every, chosen]]
            # the facet opposite to the end that is kept is between both halves
            tags[every, edges[chosen, kept]] = NO_TAG
            halves.append((half, cell_tag, tags))
        nodes, cell_tag, facet_tag = (np.concatenate(part) for part in zip(*halves, strict=True))
    nodes, cell_tag, facet_tag = (np.concatenate(part) for part in zip(*done, strict=True))
    return replace(whole, nodes=nodes, x=x, cell_tag=cell_tag, facet_tag=facet_tag)


def set_mesh_sizes(sizes: Function) -> None:
    """Make sizes the background field of the present model of Gmsh. Collective.

    Call it on all ranks, between the geometry and ``gmsh.model.mesh.generate`` on rank 0, the only
    one that needs a session of Gmsh. Other sources of sizes are switched off; ``Mesh.MeshSizeMax``
    still limits sizes.

    Parameters
    ----------
    sizes : Function
        Of degree 1, on the mesh before, such as `MeshError.sizes` returns.

    Raises
    ------
    ImportError
        On all ranks, without Gmsh.

    Examples
    --------
    >>> set_mesh_sizes(problem.mesh_error().sizes(error=0.03))  # doctest: +SKIP
    >>> gmsh.model.mesh.generate(3)  # doctest: +SKIP
    """
    space = sizes.function_space
    mesh, owned = space.mesh, owned_cells(space.mesh)
    meet(mesh.comm, "set_mesh_sizes()")
    name, vertices = cell_type(mesh).name, cell_vertices(mesh)[:owned]
    order = _compat.gmsh_order(name, vertices.shape[1]).argsort()
    x = mesh.geometry.x[vertices[:, order]].transpose(0, 2, 1)
    values = sizes.x.array[vertex_nodes(space)[:owned][:, order]]
    parts = mesh.comm.gather(np.concatenate([x.reshape(owned, -1), values], axis=1))
    with raise_collectively(mesh.comm):
        if parts is not None:
            rows, gmsh = np.concatenate(parts), import_gmsh()
            view = gmsh.view.add("cell size")
            gmsh.view.addListData(view, _VIEWS[name], len(rows), rows.ravel().tolist())
            field = gmsh.model.mesh.field.add("PostView")
            gmsh.model.mesh.field.setNumber(field, "ViewTag", view)
            gmsh.model.mesh.field.setAsBackgroundMesh(field)
            for source in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
                gmsh.option.setNumber(f"Mesh.MeshSize{source}", 0)
