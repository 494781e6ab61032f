"""A row of equal boxes cut from one body: congruent subdomains, whatever the cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from scenes import dimension

import ufl
from dolfinx import fem

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.assembly import prepare_forms
from fenics_tfeti.fem.decomposition.parts import number_parts
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

NUMBER = 4  # boxes in a row, each 1 wide
BOTTOM, LEFT = 5, 6
INSIDE = 1.5  # in the second box


@dataclass
class Row:
    """The boxes; none of their nodes is at a binary fraction, so that coordinates are rounded."""

    mesh: Any
    V: Any
    parts: list[Any]
    middle: Any  # x of each cell's midpoint
    facet_tags: Any

    @property
    def dx(self) -> Any:
        return ufl.Measure("dx", domain=self.mesh)

    @property
    def ds(self) -> Any:
        return ufl.Measure("ds", domain=self.mesh, subdomain_data=self.facet_tags)

    def cells_near(self, x: float) -> Any:
        return np.flatnonzero(np.abs(self.middle - x) < 0.15).astype(np.int32)


def row_of_boxes(cell: str = "quadrilateral", far: float = 0.1) -> Row:
    """Return the boxes from x = `far` on; tags BOTTOM and LEFT are on the whole row's facets."""
    gdim, n = dimension(cell), 3
    lower = (far, *(0.1,) * (gdim - 1))
    upper = (far + NUMBER, *(1.1,) * (gdim - 1))
    domain = boxes(MPI.COMM_SELF, [Box(lower, upper, (NUMBER * n, *(n,) * (gdim - 1)))], cell).mesh
    middle = domain.geometry.x[_compat.geometry_cells(domain)].mean(axis=1)[:, 0] - far
    label = np.floor(middle).astype(int)
    tags = tag_facets(
        domain,
        {BOTTOM: lambda x: np.isclose(x[gdim - 1], 0.1), LEFT: lambda x: np.isclose(x[0], far)},
    )
    V = displacement_space(domain)
    cells = [np.flatnonzero(label == i).astype(np.int32) for i in range(NUMBER)]
    return Row(domain, V, number_parts(V, cells, [0] * NUMBER), middle, tags)


def assemble(row: Row, a: Any, L: Any = None) -> list[Any]:
    """Return the subdomains; by default without load."""
    v = ufl.TestFunction(row.V)
    zero = fem.Constant(row.mesh, 0.0)
    return prepare_forms(row.V, a, zero * v[0] * row.dx if L is None else L).subdomains(row.parts)
