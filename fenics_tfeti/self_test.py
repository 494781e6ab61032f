"""A small contact problem with a known solution, to test an installation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti.fem.contact.contact import ContactPair
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.problem import ContactProblem

# Largest error of the self-test, relative to the exact pressure.
_EXACT = 1e-6


@dataclass(frozen=True)
class SelfTest:
    """Result of the self-test."""

    error: float  # largest error of the contact pressures, relative to the exact one
    products: int  # with F
    seconds: float  # wall time, most of it for the compilation of forms

    @property
    def passed(self) -> bool:
        """True if the pressures are exact up to the tolerance of the solution."""
        return self.error <= _EXACT


def self_test(comm: MPI.Intracomm) -> SelfTest:
    """Press a block on another one that is meshed apart; the pressure is uniform. Collective."""
    begin = time.perf_counter()
    lower, upper, bottom, top, walls = 1, 2, 3, 4, (5, 6)
    solids = [Box((0, 0, 0), (1, 1, 1), (5, 5, 3)), Box((0, 0, 1), (1, 1, 2), (4, 4, 3))]
    blocks = boxes(comm, solids, "hexahedron")

    def on_plane(axis: int, place: float) -> Callable[[Any], Any]:
        return lambda x: np.isclose(x[axis], place)

    markers: list[Any] = [(lower, on_plane(2, 1.0), 1), (upper, on_plane(2, 1.0), 2)]
    markers += [
        (bottom, on_plane(2, 0.0)),
        (top, on_plane(2, 2.0)),
        *((walls[k], on_plane(k, 0.0)) for k in (0, 1)),
    ]
    facet_tags = tag_facets(blocks.mesh, markers, blocks.cell_tags)
    V = displacement_space(blocks.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    E, nu, pressure = 2.0, 0.25, fem.Constant(blocks.mesh, 1e-3)
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    strain = ufl.sym(ufl.grad(u))
    stress = 2 * mu * strain + lam * ufl.tr(strain) * ufl.Identity(3)
    ds = ufl.Measure("ds", domain=blocks.mesh, subdomain_data=facet_tags)
    blocks.mesh.topology.create_connectivity(2, 3)
    bcs = []
    for axis, tag in enumerate((*walls, bottom)):
        dofs = fem.locate_dofs_topological(V.sub(axis), 2, facet_tags.find(tag))
        bcs.append(fem.dirichletbc(np.float64(0.0), dofs, V.sub(axis)))
    problem = ContactProblem(
        ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx,
        -pressure * v[2] * ds(top),
        bcs=bcs,
        contacts=[ContactPair(facet_tags, slave=upper, master=lower)],
        cell_tags=blocks.cell_tags,
        options={"rtol": 1e-9, "subdomain_size": 200},
    )
    problem.solve()
    computed = problem.results[0].gather().pressure
    error = float(np.abs(computed / float(pressure.value) - 1.0).max())
    seconds = comm.allreduce(time.perf_counter() - begin, MPI.MAX)
    return SelfTest(error, problem.report.products["total"], seconds)
