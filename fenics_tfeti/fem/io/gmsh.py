"""Meshes from Gmsh files, with tagged cells and facets."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.io.interfaces import Interface, split_interfaces
from fenics_tfeti.fem.io.tagged_mesh import TaggedMesh
from fenics_tfeti.fem.reference_cells import MESH_CELLS
from fenics_tfeti.parallel import raise_collectively

_log = logging.getLogger(__name__)

# Gmsh's names of entities, by dimension
_ENTITY = ("point", "curve", "surface", "volume")
# the point of the last double click on a graph of the graphical interface
_UNUSED_OPTION = "PostProcessing.DoubleClickedGraphPointX"


def read_msh(
    path: str | os.PathLike[str],
    comm: MPI.Comm = MPI.COMM_WORLD,
    gdim: int = 3,
    split: Sequence[Interface] = (),
) -> TaggedMesh:
    """Read a mesh and its physical groups from a Gmsh file.

    Rank 0 reads the file, then dolfinx distributes the cells. Nodes at the same place are not
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
    path = Path(path)
    with raise_collectively(comm):
        gmsh = _import_gmsh()
    with ExitStack() as session:
        names: dict[str, int] = {}
        tagged_facets = 0
        with raise_collectively(comm):
            if comm.rank == 0:
                session.enter_context(_opened_file(gmsh, path))
                names, tagged_facets = _prepare(gmsh.model, path, gdim)
        names, tagged_facets = comm.bcast((names, tagged_facets))
        mesh, cell_tags, facet_tags = _compat.gmsh_model_to_mesh(gmsh.model, comm, gdim)

    mesh.topology.create_connectivity(gdim - 1, gdim)
    owned = mesh.topology.index_map(gdim - 1).size_local
    received = comm.allreduce(int(np.count_nonzero(facet_tags.indices < owned)))
    if received != tagged_facets:
        raise _not_facets(path, tagged_facets - received, tagged_facets, gdim - 1)
    tagged = TaggedMesh(mesh, cell_tags, facet_tags, names)
    return split_interfaces(tagged, split) if split else tagged


def _prepare(model: Any, path: Path, gdim: int) -> tuple[dict[str, int], int]:
    """Check what dolfinx requires; its own errors, on rank 0 alone, would leave ranks waiting.

    Return name -> tag of the physical groups, and the number of tagged facets.
    """
    dimension = max((d for d in range(4) if len(model.mesh.getElementTypes(d))), default=0)
    if dimension == 0:
        raise InputError(f"{path} has no cells; was it damaged, or saved before meshing?")
    _check_dimension(model, path, dimension, gdim)
    types = {_cell_type(model, element) for element in model.mesh.getElementTypes(dimension)}
    if len(types) > 1 or not types <= set(MESH_CELLS):
        raise InputError(
            f"{path} has cells of the types {', '.join(sorted(types))}; supported are meshes of "
            f"one type out of {', '.join(MESH_CELLS)}"
        )
    cells, facets = (
        [(d, tag) for d, tag in model.getPhysicalGroups() if d == dimension - codim]
        for codim in (0, 1)
    )
    _check_cell_groups(model, cells, path, dimension)
    _check_cell_nodes(model, path, dimension)
    tagged_facets = _check_facet_groups(model, facets, path, dimension - 1)
    if len(model.getPhysicalGroups()) > len(cells + facets):
        _keep_groups(model, cells + facets)
    nodes = model.mesh.getNodes()[0]
    if len(nodes) != nodes.max():
        model.mesh.renumberNodes()  # dolfinx requires numbers without gaps
    return _names(model, cells + facets, path), tagged_facets


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


def _check_cell_nodes(model: Any, path: Path, dim: int) -> None:
    """Check that no cell is there twice or has a node twice; warn about nodes of no cell."""
    types, _, rows = model.mesh.getElements(dim)
    cells = np.sort(rows[0].reshape(-1, model.mesh.getElementProperties(types[0])[3]), axis=1)

    def describe(wrong: NDArray[Any]) -> str:
        first = format_point(np.mean([model.mesh.getNode(n)[0] for n in cells[wrong[0]]], axis=0))
        return f"{len(wrong)} of {len(cells)}, the first around {first}"

    collapsed = np.flatnonzero(np.any(cells[:, 1:] == cells[:, :-1], axis=1))
    if len(collapsed):
        raise InputError(
            f"{path} has cells with the same node twice: {describe(collapsed)}; mesh there again, "
            "without collapsed cells"
        )
    distinct = np.unique(cells, axis=0, return_index=True)[1]
    repeated = np.setdiff1d(np.arange(len(cells)), distinct)
    if len(repeated):
        raise InputError(
            f"{path} has several cells with the same nodes: {describe(repeated)}; remove the "
            "copies (removeDuplicateElements in Gmsh)"
        )
    unused = np.setdiff1d(model.mesh.getNodes()[0], cells)
    if len(unused):
        # such as centres of circles, which Gmsh saves if its option Mesh.SaveAll is set
        first = format_point(model.mesh.getNode(unused[0])[0])
        _log.warning("%s: left out %d nodes of no cell, one at %s", path, len(unused), first)


def _check_cell_groups(model: Any, groups: list[tuple[int, int]], path: Path, dim: int) -> None:
    """Check that each cell is in exactly one physical group."""
    kind = _ENTITY[dim]
    if not groups:
        raise InputError(
            f"{path} has no physical {kind} group; give each body one (addPhysicalGroup({dim}, "
            f"...) or 'Physical {kind.capitalize()}' in Gmsh) and save the mesh again"
        )
    parts = [np.concatenate(_elements(model, *group, path)[0]) for group in groups]
    grouped = np.concatenate(parts)
    every = np.concatenate(model.mesh.getElements(dim)[1])
    if names := _groups_in_common(model, groups, parts):
        raise InputError(
            f"{path}: a cell is in several physical {kind} groups, {names}; it must be in one"
        )
    if len(grouped) != len(every):
        raise InputError(
            f"{path}: {len(every) - len(grouped)} of {len(every)} cells are in no physical {kind} "
            "group; give each body one"
        )


def _check_facet_groups(model: Any, groups: list[tuple[int, int]], path: Path, dim: int) -> int:
    """Check that no facet is in two physical groups; return the number of facets in groups."""
    nodes = [_elements(model, *group, path)[1] for group in groups]
    if not nodes:
        return 0
    if len({rows.shape[1] for entities in nodes for rows in entities}) > 1:
        raise InputError(f"{path}: the facets are of different types; use cells of one type")
    parts = [np.sort(np.concatenate(entities), axis=1) for entities in nodes]
    facets = np.concatenate(parts)
    if names := _groups_in_common(model, groups, parts):
        raise InputError(
            f"{path}: a facet is in several physical {_ENTITY[dim]} groups, {names}, but can have "
            "only one tag; split the groups so that they do not overlap"
        )
    in_cells = np.unique(model.mesh.getElements(dim + 1)[2][0])
    orphans = np.count_nonzero(~np.isin(facets, in_cells).all(axis=1))
    if orphans:
        raise _not_facets(path, orphans, len(facets), dim)
    return len(facets)


def _not_facets(path: Path, count: int, total: int, dim: int) -> InputError:
    return InputError(
        f"{path}: {count} of the {total} elements in the physical {_ENTITY[dim]} groups are not "
        f"facets of cells; mesh the {_ENTITY[dim + 1]}s again"
    )


def _groups_in_common(model: Any, groups: list[tuple[int, int]], parts: list[Any]) -> str:
    """Name the groups of the first row that is in `parts` more than once, or return nothing."""
    _, number, counts = np.unique(
        np.concatenate(parts), axis=0, return_inverse=True, return_counts=True
    )
    if (counts == 1).all():
        return ""
    group = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    common = group[number.ravel() == counts.argmax()]
    return " and ".join(f"'{model.getPhysicalName(*groups[i]) or groups[i][1]}'" for i in common)


def _elements(model: Any, dim: int, group: int, path: Path) -> tuple[list[Any], list[Any]]:
    """Return numbers (m,) and nodes (m, v) of the elements of each entity of a physical group."""
    numbers, nodes = [], []
    for entity in model.getEntitiesForPhysicalGroup(dim, group):
        types, tags, rows = model.mesh.getElements(dim, entity)
        if len(types) != 1:
            raise InputError(
                f"{path}: {_ENTITY[dim]} {entity} of physical group {group} has elements of "
                f"{len(types)} types, not of one; mesh it, or remove it from the group"
            )
        numbers.append(tags[0])
        nodes.append(rows[0].reshape(len(tags[0]), -1))
    return numbers, nodes


def _cell_type(model: Any, element_type: int) -> str:
    """Return the name in dolfinx of a Gmsh element type, such as "hexahedron"."""
    # Gmsh's names are such as "Hexahedron 8"
    return str(model.mesh.getElementProperties(element_type)[0]).split()[0].lower()


def _keep_groups(model: Any, groups: list[tuple[int, int]]) -> None:
    """Remove other physical groups: dolfinx crashes on points and curves that are in no cell."""
    kept = [
        (dim, model.getEntitiesForPhysicalGroup(dim, tag), tag, model.getPhysicalName(dim, tag))
        for dim, tag in groups
    ]
    # all at once: Gmsh 4.8 fails to remove single ones that come from a file
    model.removePhysicalGroups()
    for dim, entities, tag, name in kept:
        model.addPhysicalGroup(dim, entities, tag)
        model.setPhysicalName(dim, tag, name)


def _names(model: Any, groups: list[tuple[int, int]], path: Path) -> dict[str, int]:
    """Return name -> tag, without names of several tags."""
    named: dict[str, set[int]] = {}
    for dim, tag in groups:
        if name := model.getPhysicalName(dim, tag):
            named.setdefault(name, set()).add(tag)
    for name in [name for name, tags in named.items() if len(tags) > 1]:
        tags = named.pop(name)
        _log.warning("%s: the groups %s share the name '%s'; use numbers", path, sorted(tags), name)
    return {name: tags.pop() for name, tags in named.items()}


# -- sessions of Gmsh, without effect on the user's own ----------------------------------------


def _import_gmsh() -> Any:
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
