"""A foot on a table that sticks out on all sides."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from scenes import YOUNG, at, elasticity, fixed, vector_space

import ufl
from dolfinx.fem import Constant

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import Box, boxes, tag_facets

PRESSURE, LOW, WIDTH = 1e6, 0.2, 0.6
LOADED, CLAMPED, TABLE, FOOT = 1, 2, 10, 11


def foot_on_table(
    cell: str,
    grid: tuple[int, int],
    offset: float = 0.0,
    slave: int = TABLE,
    comm: MPI.Comm = MPI.COMM_SELF,
    **of_pair: Any,
) -> ContactProblem:
    """Solve for a block of 0.6 m that is pressed on a table of 1 m, off its middle along all axes.

    Parameters
    ----------
    cell : str
        Type of the cells.
    grid : (int, int)
        Cells along the table's and the foot's sides.
    offset : float
        Distance of the foot from the middle along each axis [m].
    slave : int
        TABLE or FOOT.
    of_pair
        Further arguments of the pair.
    """
    across = 1 if cell in ("triangle", "quadrilateral") else 2
    on_table, on_foot = grid
    low = LOW + offset
    parts = [
        Box((0.0,) * (across + 1), (1.0,) * across + (0.5,), (on_table,) * across + (4,)),
        Box((low,) * across + (0.5,), (low + WIDTH,) * across + (1.0,), (on_foot,) * across + (3,)),
    ]
    blocks = boxes(comm, parts, cell)
    sides = [
        (LOADED, at(across, 1.0)),
        (CLAMPED, at(across, 0.0)),
        (TABLE, at(across, 0.5), 1),
        (FOOT, at(across, 0.5), 2),
    ]
    tags: Any = tag_facets(blocks.mesh, sides, blocks.cell_tags)
    V = vector_space(blocks.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=blocks.mesh, subdomain_data=tags)
    pressure = Constant(blocks.mesh, PRESSURE)
    pair = ContactPair(tags, slave, TABLE + FOOT - slave, partners="mortar", **of_pair)
    problem = ContactProblem(
        elasticity(u, v, Constant(blocks.mesh, YOUNG)),
        -pressure * v[across] * ds(LOADED),
        bcs=[fixed(V, tags, CLAMPED, None)],
        contacts=[pair],
        cell_tags=blocks.cell_tags,
        options={"rtol": 1e-8},
    )
    problem.solve()
    return problem
