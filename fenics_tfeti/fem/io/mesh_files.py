"""Meshes from the files of other programs: decks of Abaqus and CalculiX, MED, XDMF, VTK."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.io.abaqus import read_deck
from fenics_tfeti.fem.io.gmsh import prepared, read_msh
from fenics_tfeti.fem.io.interfaces import Interface
from fenics_tfeti.fem.io.mesh_sets import Key, MeshSets, whole_mesh
from fenics_tfeti.fem.io.tagged_mesh import TaggedMesh, distribute
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Numbers

# what files of MED have: numbers of families, which have names
_FAMILIES = "cell_tags", "point_tags"


def read_mesh(
    path: str | os.PathLike[str],
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    gdim: int = 3,
    *,
    facets: str | os.PathLike[str] | None = None,
    names: Sequence[Key] | None = None,
    data: str | None = None,
    split: Sequence[Interface] = (),
    straighten: bool = False,
) -> TaggedMesh:
    """Read a mesh with sets of nodes, elements and facets from a file of another program.

    Sets of cells, or numbers of cells, become tags of cells. Those of facets become tags of facets,
    and so do sets of nodes: facets on the boundary that have all corners in one. Where a set of
    elements has the same name as a set of nodes, it counts. Sets of all cells are left out where
    there are others. Serendipity cells of 8 and 20 nodes get nodes in the middle of their faces
    and of themselves. Rank 0 reads, then the cells are distributed body by body, as for `read_msh`.
    Collective.

    Parameters
    ----------
    path : path-like
        A deck of Abaqus or CalculiX (.inp), a file of Salome (.med) or any other that meshio reads
        (.xdmf, .vtu, .bdf, ...); .msh files are read by `read_msh`.
    comm : MPI.Comm
        Communicator of the mesh.
    gdim : int
        Number of coordinates, 2 or 3, equal to the dimension of the cells.
    facets : path-like, optional
        A second file with the same points and the facets, as is usual with XDMF.
    names : sequence of str or int, optional
        The sets, or numbers, that are to be tags; by default all.
    data : str, optional
        The data of cells with their numbers, where there are several.
    split : sequence of Interface
        Surfaces between bodies that share their nodes, to be opened by `split_interfaces`.
    straighten : bool
        Whether folded cells of degree 2 get straight sides, as by `read_msh`.

    Returns
    -------
    TaggedMesh
        Names have the tags 1, 2, ... in the order of the file, first those of cells, unless the
        file has numbers for them.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If meshio, or what it needs, is missing.
    InputError
        If the file cannot be read, cells are of several types, or the sets do not give each cell
        one tag and each facet at most one. All errors are raised on all ranks.

    Examples
    --------
    >>> parts = read_mesh("pump.inp", MPI.COMM_WORLD)  # doctest: +SKIP
    >>> parts = read_mesh("pump.inp", names=["housing", "shaft", "seat"])  # doctest: +SKIP
    """
    path, whole = Path(path), None
    if path.suffix == ".msh":
        if facets is not None or names is not None or data is not None:
            raise InputError(f"{path}: facets, names and data are not for .msh files; use read_msh")
        return read_msh(path, comm, gdim, split, straighten)
    with raise_collectively(comm):
        if comm.rank == 0:
            sets = _read(path, data)
            if facets is not None:
                sets = _joined(sets, _read(Path(facets), data))
            whole = prepared(path, whole_mesh(sets, gdim, names), split, straighten)
    return distribute(comm, whole)


def _read(path: Path, data: str | None) -> MeshSets:
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no mesh file '{path}' (looked in {Path.cwd()}); check the path"
        )
    return read_deck(path) if path.suffix == ".inp" else _from_meshio(path, data)


def _from_meshio(path: Path, data: str | None) -> MeshSets:
    """Return the mesh of a file that meshio reads."""
    try:
        import meshio
    except ImportError as error:
        raise ImportError(
            f"reading {path} needs meshio ({error}); install it by 'pip install meshio h5py'"
        ) from error
    try:
        mesh = meshio.read(path)
    except ImportError as error:
        raise ImportError(
            f"reading {path} needs another package ({error}), such as h5py: 'pip install h5py', or "
            "'apt install python3-h5py' beside Debian's dolfinx"
        ) from error
    # meshio ends the process where it knows no format, and its readers raise errors of all kinds
    except (Exception, SystemExit) as error:
        raise InputError(
            f"meshio cannot read {path} ({error or 'a format that it does not know'}); formats are "
            "known by the ends of names, such as .med, .xdmf and .vtu"
        ) from error
    x = np.zeros((len(mesh.points), 3))
    x[:, : mesh.points.shape[1]] = mesh.points
    blocks = [(block.type, np.asarray(block.data, dtype=np.int64)) for block in mesh.cells]
    elements, tags = _numbered(path, mesh, data)
    elements |= _families(getattr(mesh, "cell_tags", {}), mesh.cell_data.get("cell_tags"))
    starts = np.cumsum([0, *(len(nodes) for _, nodes in blocks)])
    for name, parts in mesh.cell_sets.items():
        chosen = [
            start + np.asarray(part, dtype=np.int64)
            for start, part in zip(starts, parts, strict=False)
            if part is not None
        ]
        elements[name] = np.concatenate([np.zeros(0, dtype=np.int64), *chosen])
    of_points = mesh.point_data.get("point_tags")
    nodes = _families(getattr(mesh, "point_tags", {}), None if of_points is None else [of_points])
    nodes |= {name: np.asarray(part, dtype=np.int64) for name, part in mesh.point_sets.items()}
    return MeshSets(path, x, blocks, elements, nodes, {}, tags)


def _families(families: dict[int, list[str]], numbers: Any) -> dict[Any, Numbers]:
    """Return the elements or nodes of each group of MED; a family is of several groups."""
    if numbers is None:
        return {}
    of_all = np.concatenate(numbers)
    groups: dict[Any, list[Numbers]] = {}
    for family, names in families.items():
        for name in names:
            groups.setdefault(name.strip(), []).append(np.flatnonzero(of_all == family))
    return {name: np.sort(np.concatenate(parts)) for name, parts in groups.items()}


def _numbered(path: Path, mesh: Any, data: str | None) -> tuple[dict[Key, Numbers], dict[str, int]]:
    """Return the elements of each number in the data of cells, by name if it has one; the tags."""
    found = {
        name: np.concatenate(parts)
        for name, parts in mesh.cell_data.items()
        if name not in _FAMILIES and all(np.ndim(part) == 1 for part in parts)
    }
    whole = {name: v for name, v in found.items() if (np.isfinite(v) & (v == np.round(v))).all()}
    if data is not None:
        if data not in whole:
            raise InputError(
                f"{path} has no numbers of cells {data!r}; there are {sorted(whole) or 'none'}"
            )
        whole = {data: whole[data]}
    if len(whole) > 1:
        raise InputError(
            f"{path} has several numbers for each cell, {sorted(whole)}: choose one by data=..."
        )
    elements: dict[Key, Numbers] = {}
    named = {int(value[0]): name for name, value in mesh.field_data.items() if np.size(value) == 2}
    for values in whole.values():
        for number in np.unique(values).astype(int).tolist():
            elements[named.get(number, number)] = np.flatnonzero(values == number)
    return elements, {name: number for number, name in named.items() if name in elements}


def _joined(mesh: MeshSets, facets: MeshSets) -> MeshSets:
    """Return a mesh with the elements of a second file on the same points."""
    if mesh.x.shape != facets.x.shape or not np.allclose(mesh.x, facets.x, rtol=0, atol=0):
        raise InputError(
            f"{facets.path} has other points than {mesh.path}: write both files with the points of "
            "one mesh"
        )
    count = sum(len(nodes) for _, nodes in mesh.blocks)
    elements = dict(mesh.elements)
    for key, part in facets.elements.items():
        elements[key] = np.concatenate([elements.get(key, part[:0]), count + part])
    return MeshSets(
        mesh.path,
        mesh.x,
        [*mesh.blocks, *facets.blocks],
        elements,
        {**facets.nodes, **mesh.nodes},
        {},
        {**facets.tags, **mesh.tags},
    )
