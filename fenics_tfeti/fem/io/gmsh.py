"""Meshes from Gmsh files, with tagged cells and facets."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import InputError, format_point, warn_user
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.geometry.reference_cells import MESH_CELLS, reference_cell
from fenics_tfeti.fem.io.interfaces import Interface, open_interfaces
from fenics_tfeti.fem.io.straight_cells import straighten_folded_cells
from fenics_tfeti.fem.io.tagged_mesh import TaggedMesh, WholeMesh, distribute, tags_by_corners
from fenics_tfeti.fem.topology import distinct_rows
from fenics_tfeti.parallel import positions, raise_collectively
from fenics_tfeti.typing import Array, Numbers, Vector

_log = logging.getLogger(__name__)

# Gmsh's names of entities, by dimension
_ENTITY = ("point", "curve", "surface", "volume")
# the point of the last double click on a graph of the graphical interface
_UNUSED_OPTION = "PostProcessing.DoubleClickedGraphPointX"


def read_msh(
    path: str | os.PathLike[str],
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    gdim: int = 3,
    split: Sequence[Interface] = (),
    straighten: bool = False,
) -> TaggedMesh:
    """Read a mesh and its physical groups from a Gmsh file.

    Rank 0 reads the file, then cells are distributed body by body. Nodes at the same place are not
    merged: bodies that touch stay separate bodies. Bodies that share nodes, as `fragment` of Gmsh
    makes them, are separated at the interfaces in `split`. Nodes of no cell are left out, with a
    warning in the log. Collective.

    Parameters
    ----------
    path : path-like
        A .msh file of version 2 or 4, with a physical group on each body and on each surface that
        is to be tagged.
    comm : MPI.Comm
        Communicator of the mesh.
    gdim : int
        Number of coordinates, 2 or 3, equal to the dimension of the cells.
    split : sequence of Interface
        Surfaces between bodies that share their nodes, to be opened by `split_interfaces`.
    straighten : bool
        Whether cells of degree 2 that are folded get straight sides, with a warning that counts
        them: their nodes between corners are put on the middles of straight edges, flat faces and
        cells. All other nodes stay.

    Returns
    -------
    TaggedMesh
        The tags are the numbers of the physical groups, and `names` maps their names to tags.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If the Python module of Gmsh is missing.
    InputError
        If the file cannot be read, a cell is in it twice or has a node twice, or the physical
        groups do not give each cell one tag and each facet at most one; errors of
        `split_interfaces`. All errors are raised on all ranks.

    Examples
    --------
    >>> beams = read_msh("meshes/two_beams.msh")  # doctest: +SKIP
    >>> beams.facet_tags.find(beams.names["clamped"])  # doctest: +SKIP
    """
    path, whole = Path(path), None
    with raise_collectively(comm):
        gmsh = import_gmsh()
    with raise_collectively(comm):
        if comm.rank == 0:
            with _opened_file(gmsh, path):
                whole = _whole_mesh(gmsh.model, path, gdim)
            whole = prepared(path, whole, split, straighten)
    return distribute(comm, whole)


def prepared(
    path: Path, whole: WholeMesh, split: Sequence[Interface], straighten: bool
) -> WholeMesh:
    """Return a mesh with straight cells in place of folded ones, and with open interfaces."""
    if straighten:
        whole, message = straighten_folded_cells(whole)
        if message:
            warn_user(f"{path}: {message}")
    return open_interfaces(whole, split) if split else whole


@dataclass(frozen=True)
class _Group:
    """The elements of a physical group."""

    tag: int
    name: str
    numbers: Array  # (m,)
    nodes: Array  # (m, n) in Gmsh's order


def _whole_mesh(model: Any, path: Path, gdim: int) -> WholeMesh:
    """Return the mesh of a model, checked, with the numbers of physical groups as tags."""
    dimension = max((d for d in range(4) if len(model.mesh.getElementTypes(d))), default=0)
    if dimension == 0:
        raise InputError(f"{path} has no cells; was it damaged, or saved before meshing?")
    _check_dimension(model, path, dimension, gdim)
    elements = [model.mesh.getElementProperties(e) for e in model.mesh.getElementTypes(dimension)]
    # Gmsh's names are such as "Hexahedron 8"
    types = {str(name).split()[0].lower() for name, *_ in elements}
    if len(types) > 1 or not types <= set(MESH_CELLS):
        raise InputError(
            f"{path} has cells of the types {', '.join(sorted(types))}; supported are meshes of "
            f"one type out of {', '.join(MESH_CELLS)}"
        )
    (cell,), (name, _, degree, size, *_) = types, elements[0]
    if degree > 2 or size != reference_cell(cell).nodes(degree):
        raise InputError(
            f"{path} has cells of the type {name}; supported are those of degree 1 and 2 (setOrder "
            "in Gmsh) with nodes on faces and in cells too (Mesh.SecondOrderIncomplete = 0)"
        )
    bodies, surfaces = _groups(model, path, dimension), _groups(model, path, dimension - 1)
    _check_cell_groups(model, bodies, path, dimension)
    used, nodes = np.unique(np.concatenate([g.nodes for g in bodies]), return_inverse=True)
    nodes = nodes.reshape(-1, bodies[0].nodes.shape[1])
    numbers, x, _ = model.mesh.getNodes()
    order = np.argsort(numbers)
    x = x.reshape(-1, 3)[order]
    row = positions(numbers[order].astype(np.int64), used.astype(np.int64))
    check_distinct_cells(path, nodes, x[row])
    if row.size < len(x):
        # such as centres of circles, which Gmsh saves if its option Mesh.SaveAll is set
        first = format_point(np.delete(x, row, axis=0)[0])
        _log.warning("%s: left out %d nodes of no cell, one at %s", path, len(x) - row.size, first)
    nodes = nodes[:, _compat.gmsh_order(cell, nodes.shape[1])]
    return WholeMesh(
        cell,
        degree,
        nodes,
        x[row, :gdim],
        np.repeat([g.tag for g in bodies], [len(g.nodes) for g in bodies]),
        _facet_tags(path, cell, nodes, surfaces, used),
        _names(path, bodies + surfaces),
        {g.tag: g.name for g in bodies if g.name},
    )


def _groups(model: Any, path: Path, dim: int) -> list[_Group]:
    """Return the physical groups of a dimension."""
    groups = []
    for _, tag in model.getPhysicalGroups(dim):
        numbers, nodes = [], []
        for entity in model.getEntitiesForPhysicalGroup(dim, tag):
            types, elements, rows = model.mesh.getElements(dim, entity)
            if len(types) != 1:
                raise InputError(
                    f"{path}: {_ENTITY[dim]} {entity} of physical group {tag} has elements of "
                    f"{len(types)} types, not of one; mesh it, or remove it from the group"
                )
            numbers.append(elements[0])
            nodes.append(rows[0].reshape(len(elements[0]), -1))
        if len({rows.shape[1] for rows in nodes}) > 1:
            raise InputError(f"{path}: the facets are of different types; use cells of one type")
        name = model.getPhysicalName(dim, tag)
        groups.append(_Group(tag, name, np.concatenate(numbers), np.concatenate(nodes)))
    return groups


def _check_dimension(model: Any, path: Path, dimension: int, gdim: int) -> None:
    """Check that the file has cells of as many dimensions as coordinates are wanted."""
    if dimension == gdim:
        return
    remedy = f"pass gdim={dimension}"
    if dimension < gdim:
        kind, z = _ENTITY[gdim], model.mesh.getNodes()[1][2::3]
        flat = dimension == 2 and z.max() == z.min()
        remedy = (
            f"the file has no {kind} cells. "
            + ("For a mesh in the plane pass gdim=2. " if flat else "")
            + f"Give each body a physical {kind} (addPhysicalGroup({gdim}, ...) or 'Physical "
            f"{kind.capitalize()}' in Gmsh), since of a model with physical groups Gmsh saves only "
            f"what is in one, and mesh in {gdim} dimensions"
        )
    raise InputError(
        f"the cells in {path} are of dimension {dimension}, but gdim is {gdim}: {remedy}"
    )


def check_distinct_cells(path: Path, nodes: Numbers, x: Vector) -> None:
    """Check that no cell is there twice or has a node twice."""
    cells = np.sort(nodes, axis=1)

    def describe(wrong: Numbers) -> str:
        first = format_point(x[cells[wrong[0]]].mean(axis=0))
        return f"{len(wrong)} of {len(cells)}, the first around {first}"

    collapsed = np.flatnonzero(np.any(cells[:, 1:] == cells[:, :-1], axis=1))
    if len(collapsed):
        raise InputError(
            f"{path} has cells with the same node twice: {describe(collapsed)}; mesh there again, "
            "without collapsed cells"
        )
    distinct = np.unique(distinct_rows(cells)[1], return_index=True)[1]
    repeated = np.setdiff1d(np.arange(len(cells)), distinct)
    if len(repeated):
        raise InputError(
            f"{path} has several cells with the same nodes: {describe(repeated)}; remove the "
            "copies (removeDuplicateElements in Gmsh)"
        )


def _check_cell_groups(model: Any, groups: Sequence[_Group], path: Path, dim: int) -> None:
    """Check that each cell is in exactly one physical group."""
    kind = _ENTITY[dim]
    if not groups:
        raise InputError(
            f"{path} has no physical {kind} group; give each body one (addPhysicalGroup({dim}, "
            f"...) or 'Physical {kind.capitalize()}' in Gmsh) and save the mesh again"
        )
    grouped = np.concatenate([group.numbers for group in groups])
    if names := _groups_in_common(groups, grouped):
        raise InputError(
            f"{path}: a cell is in several physical {kind} groups, {names}; it must be in one"
        )
    every = np.concatenate(model.mesh.getElements(dim)[1])
    if len(grouped) != len(every):
        raise InputError(
            f"{path}: {len(every) - len(grouped)} of {len(every)} cells are in no physical {kind} "
            "group; give each body one"
        )


def _facet_tags(
    path: Path, cell: str, nodes: Numbers, groups: Sequence[_Group], used: Array
) -> Numbers:
    """Return the tags of the facets (m, f) of cells; `used` are Gmsh's numbers of their nodes."""
    kind = reference_cell(cell)
    corners = [g.nodes[:, : kind.facet.vertices].astype(np.int64) for g in groups]
    facets = np.concatenate([np.zeros((0, kind.facet.vertices), dtype=np.int64), *corners])
    entity = _ENTITY[kind.dim - 1]
    if names := _groups_in_common(groups, distinct_rows(np.sort(facets, axis=1))[1]):
        raise InputError(
            f"{path}: a facet is in several physical {entity} groups, {names}, but can have only "
            "one tag; split the groups so that they do not overlap"
        )
    tags = np.repeat([g.tag for g in groups], [len(g.nodes) for g in groups])
    rows = positions(used.astype(np.int64), facets)
    facet_tag, is_facet = tags_by_corners(cell, nodes, rows, tags)
    if not is_facet.all():
        raise InputError(
            f"{path}: {np.count_nonzero(~is_facet)} of the {len(facets)} elements in the physical "
            f"{entity} groups are not facets of cells; mesh the {_ENTITY[kind.dim]}s again"
        )
    return facet_tag


def _groups_in_common(groups: Sequence[_Group], element: Array) -> str:
    """Name the groups that the first element is in that is in several, or return nothing."""
    _, number, counts = np.unique(element, return_inverse=True, return_counts=True)
    if (counts == 1).all():
        return ""
    group = np.repeat(np.arange(len(groups)), [len(g.nodes) for g in groups])
    common = group[number == counts.argmax()]
    return " and ".join(f"'{groups[i].name or groups[i].tag}'" for i in common)


def _names(path: Path, groups: Sequence[_Group]) -> dict[str, int]:
    """Return name -> tag, without names of several tags."""
    named: dict[str, set[int]] = {}
    for group in groups:
        if group.name:
            named.setdefault(group.name, set()).add(group.tag)
    for name in [name for name, tags in named.items() if len(tags) > 1]:
        tags = named.pop(name)
        _log.warning("%s: the groups %s share the name '%s'; use numbers", path, sorted(tags), name)
    return {name: tags.pop() for name, tags in named.items()}


# -- sessions of Gmsh, without effect on the user's own ----------------------------------------


def import_gmsh() -> Any:
    """Import the Python module of Gmsh, and keep the handler of Ctrl-C that it may replace."""
    try:
        with _interrupt_handler_kept():
            import gmsh
    except (ImportError, OSError) as error:  # OSError: its shared library is missing
        raise ImportError(
            f"reading a .msh file needs the Python module gmsh ({error}); install it with "
            "'apt install python3-gmsh' (Debian, Ubuntu) or 'pip install gmsh'"
        ) from error
    return gmsh


@contextmanager
def _opened_file(gmsh: Any, path: Path) -> Iterator[None]:
    """Open a mesh file as the current Gmsh model; close it and restore Gmsh's state at the end."""
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no mesh file '{path}' (looked in {Path.cwd()}); check the path, or make "
            "the file with Gmsh first"
        )
    with path.open("rb") as file:
        if not file.read(1024).lstrip().startswith(b"$"):
            raise InputError(f"{path} is not a Gmsh mesh file: it does not start with $MeshFormat")
    with _session(gmsh):
        gmsh.model.add("fenics_tfeti.read_msh")
        try:
            gmsh.merge(str(path))
        except Exception as error:  # Gmsh raises no class of its own
            raise InputError(
                f"Gmsh cannot read {path} ({error}); save it again as a mesh of version 4.1, or "
                "update Gmsh"
            ) from error
        yield


@contextmanager
def _session(gmsh: Any) -> Iterator[None]:
    """Open a Gmsh session without terminal output, or use the user's and restore its state."""
    with _interrupt_handler_kept():
        opened_here = _open(gmsh)
        terminal = gmsh.option.getNumber("General.Terminal")
        current = gmsh.model.getCurrent()
        models = len(gmsh.model.list())
        gmsh.option.setNumber("General.Terminal", 0)
        try:
            yield
        finally:
            if opened_here:
                gmsh.finalize()
            else:
                if len(gmsh.model.list()) > models:
                    gmsh.model.remove()
                gmsh.model.setCurrent(current)
                gmsh.option.setNumber("General.Terminal", terminal)


def _open(gmsh: Any) -> bool:
    """Open a session if the user has none; tell whether it did."""
    if hasattr(gmsh, "isInitialized"):
        if gmsh.isInitialized():
            return False
        gmsh.initialize(readConfigFiles=False)
        return True
    # Gmsh 4.8 may end the process when it is asked anything outside a session, and does not take
    # the arguments if a session is open: an option that nobody sets tells whether it took them
    with _stderr_closed():
        gmsh.initialize(["gmsh", "-setnumber", _UNUSED_OPTION, "1"], readConfigFiles=False)
    return bool(gmsh.option.getNumber(_UNUSED_OPTION) == 1)


@contextmanager
def _interrupt_handler_kept() -> Iterator[None]:
    """Restore the handler of Ctrl-C, which Gmsh replaces by one that ends the process."""
    handler = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, handler)


@contextmanager
def _stderr_closed() -> Iterator[None]:
    """Discard what a C library writes to the standard error stream."""
    copy = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(copy, 2)
        os.close(copy)
