"""Meshes from Gmsh files, with tagged cells and facets."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.parallel import raise_collectively

__all__ = ["TaggedMesh", "read_msh"]

_log = logging.getLogger(__name__)

_SHAPES = ("Triangle", "Quadrilateral", "Tetrahedron", "Hexahedron")  # as Gmsh calls them
_KIND = {0: "point", 1: "curve", 2: "surface", 3: "volume"}


@dataclass(frozen=True)
class TaggedMesh:
    """A distributed mesh with integer tags.

    Attributes
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh; coordinates in the unit of the file, metres for everything in this package.
    cell_tags : dolfinx.mesh.MeshTags
        The tag of each cell, usually the number of its body.
    facet_tags : dolfinx.mesh.MeshTags
        The tags of those facets that have one; possibly of none.
    names : dict of str to int
        Name -> tag of cells or facets; the same on all ranks.
    """

    mesh: Mesh
    cell_tags: Any
    facet_tags: Any
    names: dict[str, int]


def read_msh(
    path: str | os.PathLike[str], comm: MPI.Comm = MPI.COMM_WORLD, gdim: int = 3
) -> TaggedMesh:
    """Read a mesh and its physical groups from a Gmsh file.

    Rank 0 reads the file, then dolfinx distributes the cells. Nodes at the same place stay
    separate nodes, thus bodies that touch stay separate bodies. Nodes of no cell are left out, with
    a warning in the log. Collective.

    Parameters
    ----------
    path : path-like
        A .msh file, of version 2 or 4, with a physical group on each body and on each part of
        the surface that is to be tagged.
    comm : MPI.Comm
        Communicator of the mesh.
    gdim : int
        Number of coordinates, 3 or 2; equals the dimension of the cells.

    Returns
    -------
    TaggedMesh
        The tags are the numbers of the physical groups, `names` the names of those that have one.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If the Python module of Gmsh is missing.
    InputError
        If the file cannot be read, a cell is there twice or names a node twice, or the physical
        groups do not give each cell one tag and each facet at most one. All errors are raised on
        all ranks.

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
                session.enter_context(_opened(gmsh, path))
                names, tagged_facets = _prepare(gmsh.model, path, gdim)
        names, tagged_facets = comm.bcast((names, tagged_facets))
        mesh, cell_tags, facet_tags = _compat.gmsh_model_to_mesh(gmsh.model, comm, gdim)

    mesh.topology.create_connectivity(gdim - 1, gdim)
    owned = mesh.topology.index_map(gdim - 1).size_local
    found = comm.allreduce(int(np.count_nonzero(facet_tags.indices < owned)))
    if found != tagged_facets:
        raise _not_sides(path, tagged_facets - found, tagged_facets, gdim - 1)
    return TaggedMesh(mesh, cell_tags, facet_tags, names)


def _import_gmsh() -> Any:
    """Import the Python module of Gmsh, which old versions let take over Ctrl-C."""
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
def _opened(gmsh: Any, path: Path) -> Iterator[None]:
    """Have the file as the current Gmsh model, and leave Gmsh as it was."""
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
    """Open a quiet Gmsh session, or borrow the user's and give it back unchanged."""
    if _is_initialized(gmsh):
        terminal = gmsh.option.getNumber("General.Terminal")
        current = gmsh.model.getCurrent()
        models = len(gmsh.model.list())
        gmsh.option.setNumber("General.Terminal", 0)
        try:
            yield
        finally:
            if len(gmsh.model.list()) > models:
                gmsh.model.remove()
            gmsh.model.setCurrent(current)
            gmsh.option.setNumber("General.Terminal", terminal)
        return
    with _interrupt_handler_kept():
        gmsh.initialize(readConfigFiles=False)
        gmsh.option.setNumber("General.Terminal", 0)
        try:
            yield
        finally:
            gmsh.finalize()


def _is_initialized(gmsh: Any) -> bool:
    """Ask whether the user has a Gmsh session open."""
    if hasattr(gmsh, "isInitialized"):
        return bool(gmsh.isInitialized())
    # Gmsh 4.8 knows its version in a session only; after one, it complains before it raises.
    with _stderr_closed():
        try:
            return bool(gmsh.option.getString("General.Version"))
        except Exception:
            return False


@contextmanager
def _interrupt_handler_kept() -> Iterator[None]:
    """Restore the handler of Ctrl-C, which Gmsh replaces so that it ends the process."""
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


def _prepare(model: Any, path: Path, gdim: int) -> tuple[dict[str, int], int]:
    """Check all that dolfinx takes for granted, where it would fail on rank 0 alone and hang.

    Returns
    -------
    tuple
        Name -> tag of the physical groups, and the number of tagged facets.
    """
    dimension = max((d for d in range(4) if len(model.mesh.getElementTypes(d))), default=0)
    if dimension == 0:
        raise InputError(f"{path} holds no cells; was it damaged, or saved before meshing?")
    if dimension != gdim:
        raise InputError(
            f"the cells in {path} are of dimension {dimension}, but gdim is {gdim}; pass "
            f"gdim={dimension}, or save a mesh with {_KIND.get(gdim, 'cell')}s"
        )
    shapes = {_shape(model, element) for element in model.mesh.getElementTypes(dimension)}
    if len(shapes) > 1 or not shapes <= set(_SHAPES):
        raise InputError(
            f"{path} holds cells of the shapes {', '.join(sorted(shapes))}; supported are meshes "
            f"of one shape out of {', '.join(_SHAPES)}"
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
        model.mesh.renumberNodes()  # dolfinx wants numbers without gaps
    return _names(model, cells + facets, path), tagged_facets


def _check_cell_nodes(model: Any, path: Path, dim: int) -> None:
    """Check that no cell is there twice or has a node twice, and name nodes of no cell."""
    types, _, rows = model.mesh.getElements(dim)
    cells = np.sort(rows[0].reshape(-1, model.mesh.getElementProperties(types[0])[3]), axis=1)

    def around(wrong: NDArray[Any]) -> str:
        first = format_point(np.mean([model.mesh.getNode(n)[0] for n in cells[wrong[0]]], axis=0))
        return f"{len(wrong)} of {len(cells)}, the first around {first}"

    collapsed = np.flatnonzero(np.any(cells[:, 1:] == cells[:, :-1], axis=1))
    if len(collapsed):
        raise InputError(
            f"{path} has cells that name a node twice: {around(collapsed)}; mesh there again, "
            "without collapsed cells"
        )
    once = np.unique(cells, axis=0, return_index=True)[1]
    again = np.setdiff1d(np.arange(len(cells)), once)
    if len(again):
        raise InputError(
            f"{path} has cells that are there several times: {around(again)}; remove the copies "
            "(removeDuplicateElements in Gmsh)"
        )
    unused = np.setdiff1d(model.mesh.getNodes()[0], cells)
    if len(unused):
        # such as centres of circles, which Gmsh saves with its option Mesh.SaveAll
        first = format_point(model.mesh.getNode(unused[0])[0])
        _log.warning("%s: left out %d nodes of no cell, one at %s", path, len(unused), first)


def _check_cell_groups(model: Any, groups: list[tuple[int, int]], path: Path, dim: int) -> None:
    """Check that each cell is in exactly one physical group."""
    kind = _KIND[dim]
    if not groups:
        raise InputError(
            f"{path} has no physical {kind} group; give each body one (addPhysicalGroup({dim}, "
            f"...) or 'Physical {kind.capitalize()}' in Gmsh) and save the mesh again"
        )
    grouped = np.concatenate(
        [tags for group in groups for tags in _elements(model, *group, path)[0]]
    )
    every = np.concatenate(model.mesh.getElements(dim)[1])
    if len(np.unique(grouped)) != len(grouped):
        raise InputError(f"{path}: a cell is in several physical {kind} groups; it must be in one")
    if len(grouped) != len(every):
        raise InputError(
            f"{path}: {len(every) - len(grouped)} of {len(every)} cells are in no physical {kind} "
            "group; give each body one"
        )


def _check_facet_groups(model: Any, groups: list[tuple[int, int]], path: Path, dim: int) -> int:
    """Check that no facet is in two physical groups, and count the facets in groups."""
    nodes = [rows for group in groups for rows in _elements(model, *group, path)[1]]
    if not nodes:
        return 0
    if len({rows.shape[1] for rows in nodes}) > 1:
        raise InputError(f"{path}: the facets are of different shapes; use cells of one shape")
    facets = np.sort(np.concatenate(nodes), axis=1)
    if len(np.unique(facets, axis=0)) != len(facets):
        raise InputError(
            f"{path}: a facet is in several physical {_KIND[dim]} groups, but can have one tag "
            "only; split the groups so that they do not overlap"
        )
    in_cells = np.unique(model.mesh.getElements(dim + 1)[2][0])
    alone = np.count_nonzero(~np.isin(facets, in_cells).all(axis=1))
    if alone:
        raise _not_sides(path, alone, len(facets), dim)
    return len(facets)


def _not_sides(path: Path, count: int, total: int, dim: int) -> InputError:
    return InputError(
        f"{path}: {count} of the {total} elements in the physical {_KIND[dim]} groups are not "
        f"sides of cells; mesh the {_KIND[dim + 1]}s again"
    )


def _elements(model: Any, dim: int, group: int, path: Path) -> tuple[list[Any], list[Any]]:
    """Return numbers (m,) and nodes (m, v) of the elements of each entity of a physical group."""
    numbers, nodes = [], []
    for entity in model.getEntitiesForPhysicalGroup(dim, group):
        types, tags, rows = model.mesh.getElements(dim, entity)
        if len(types) != 1:
            raise InputError(
                f"{path}: {_KIND[dim]} {entity} of physical group {group} has elements of "
                f"{len(types)} shapes, not of one; mesh it, or take it out of the group"
            )
        numbers.append(tags[0])
        nodes.append(rows[0].reshape(len(tags[0]), -1))
    return numbers, nodes


def _shape(model: Any, element_type: int) -> str:
    """Return the shape of a Gmsh element type, "Hexahedron" for example."""
    return str(model.mesh.getElementProperties(element_type)[0]).split()[0]


def _keep_groups(model: Any, groups: list[tuple[int, int]]) -> None:
    """Remove other physical groups; dolfinx crashes at points and curves that are in no cell."""
    kept = [
        (dim, model.getEntitiesForPhysicalGroup(dim, tag), tag, model.getPhysicalName(dim, tag))
        for dim, tag in groups
    ]
    # all of them at once: Gmsh 4.8 fails at some that come from a file
    model.removePhysicalGroups()
    for dim, entities, tag, name in kept:
        model.addPhysicalGroup(dim, entities, tag)
        model.setPhysicalName(dim, tag, name)


def _names(model: Any, groups: list[tuple[int, int]], path: Path) -> dict[str, int]:
    """Return name -> tag, without the names that stand for two tags."""
    named: dict[str, set[int]] = {}
    for dim, tag in groups:
        if name := model.getPhysicalName(dim, tag):
            named.setdefault(name, set()).add(tag)
    for name in [name for name, tags in named.items() if len(tags) > 1]:
        tags = named.pop(name)
        _log.warning("%s: '%s' names the groups %s; use the numbers", path, name, sorted(tags))
    return {name: tags.pop() for name, tags in named.items()}
