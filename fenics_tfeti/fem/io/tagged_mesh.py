"""The result of reading or making a mesh: a distributed mesh with tagged cells and facets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dolfinx.mesh import Mesh


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
    """

    mesh: Mesh
    cell_tags: Any
    facet_tags: Any
    names: dict[str, int]
