"""A foot on a table that sticks out on all sides."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from scenes import Scene, at, dimension

from fenics_tfeti import ContactProblem, Mortar

PRESSURE, LOW, WIDTH = 1e6, 0.2, 0.6
LOADED, CLAMPED, TABLE, FOOT = 3, 2, 10, 11


def foot_on_table(
    cell: str,
    grid: tuple[int, int],
    offset: float = 0.0,
    slave: int = TABLE,
    comm: MPI.Comm = MPI.COMM_SELF,
    **of_pair: Any,
) -> ContactProblem:
    """Solve for a block of 0.6 m that is pressed on a table of 1 m, off its middle along all axes.

    `grid` is the numbers of cells along the table's and the foot's sides.
    """
    across = dimension(cell) - 1
    on_table, on_foot = grid
    low = LOW + offset
    parts = [
        ((0.0,) * (across + 1), (1.0,) * across + (0.5,), (on_table,) * across + (4,)),
        ((low,) * across + (0.5,), (low + WIDTH,) * across + (1.0,), (on_foot,) * across + (3,)),
    ]
    marks = [(LOADED, at(across, 1.0)), (CLAMPED, at(across, 0.0))]
    marks += [(TABLE, at(across, 0.5), 1), (FOOT, at(across, 0.5), 2)]
    scene = Scene.of_boxes(comm, cell, parts, marks)
    scene.L = -scene.constant(PRESSURE) * scene.v[across] * scene.ds(LOADED)
    scene.fix(CLAMPED)
    scene.add_pair(slave, TABLE + FOOT - slave, partners=Mortar(), **of_pair)
    problem = scene.problem(options={"rtol": 1e-8})
    problem.solve()
    return problem
