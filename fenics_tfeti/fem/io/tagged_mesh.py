"""The result of reading or making a mesh: a distributed mesh with tagged cells and facets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx.mesh import Mesh, meshtags


@dataclass(frozen=True)
class TaggedMesh:
    """A distributed mesh with integer tags.

    Attributes
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh, with coordinates in the unit of the file; the documentation of this package
        assumes metres.
    cell_tags : dolfinx.mesh.MeshTags
        The tag of each cell, usually the number of its body.
    facet_tags : dolfinx.mesh.MeshTags
        The tags of facets; those without a tag are left out.
    names : dict of str to int
        Name -> tag of cells or facets; the same on all ranks.

    Examples
    --------
    >>> parts = read_msh("pump.msh", MPI.COMM_WORLD)  # doctest: +SKIP
    >>> parts.facet_tags.find(parts.names["seat"])  # doctest: +SKIP
    """

    mesh: Mesh
    cell_tags: Any
    facet_tags: Any
    names: dict[str, int]


def sorted_tags(mesh: Mesh, dim: int, entities: NDArray[Any], values: NDArray[Any]) -> Any:
    """Return mesh tags of entities of this rank that are in any order."""
    order = np.argsort(entities)
    return meshtags(mesh, dim, entities[order].astype(np.int32), values[order].astype(np.int32))
