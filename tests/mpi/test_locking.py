"""The warning of locking: on rank 0, for the cells of all ranks."""

from __future__ import annotations

import warnings

from mpi4py import MPI

import numpy as np
from scenes import YOUNG, elasticity, fixed, vector_space

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem
from fenics_tfeti.io import Box, boxes, tag_facets

COMM = MPI.COMM_WORLD


def told(comm):
    """Return the warnings of two blocks, of which the second is nearly incompressible."""
    pair = [Box((0, 0), (1, 1), (4, 4)), Box((3, 0), (4, 1), (4, 4))]
    parts = boxes(comm, pair, "quadrilateral")
    tags = tag_facets(parts.mesh, {1: lambda x: np.isclose(x[1], 0.0)})
    V = vector_space(parts.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dx = ufl.Measure("dx", domain=parts.mesh, subdomain_data=parts.cell_tags)
    young = fem.Constant(parts.mesh, YOUNG)
    bulk = fem.Constant(parts.mesh, 1e3 * YOUNG)
    a = elasticity(u, v, young) + bulk * ufl.div(u) * ufl.div(v) * dx(2)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ContactProblem(a, 0, bcs=[fixed(V, tags, 1, None)], cell_tags=parts.cell_tags)
    return [str(warning.message) for warning in caught if warning.category is UserWarning]


def test_rank_0_warns_as_one_rank_alone_does():
    alone, together = told(MPI.COMM_SELF), told(COMM)
    assert len(alone) == 1
    assert alone[0].startswith("body 1 (cell tag 2)")
    assert together == (alone if COMM.rank == 0 else [])
