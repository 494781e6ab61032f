"""A stiff tool that is pressed into a nearly incompressible block, with the volume by one point."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Tresca
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

BOTTOM, BLOCK, TOOL, PRESSED = 1, 2, 3, 4


def pressed_blocks(
    comm: MPI.Intracomm,
    gdim: int,
    nu: float,
    degree: int = 1,
    friction: bool = False,
    **options: Any,
) -> ContactProblem:
    """Return the problem, with Poisson's ratio of the block."""
    n = 8 // degree
    lower, upper = (2.0, 1.0, 1.0)[:gdim], (1.5, 1.0, 1.5)[:gdim]
    if gdim == 2:
        n, lower, upper = 2 * n, (2.0, 1.0), (1.5, 1.5)
    corner = (0.5, *[0.0] * (gdim - 2), 1.0)
    grid = [int(n * (b - a)) for a, b in zip(corner, upper, strict=True)]
    bodies = boxes(
        comm,
        [
            Box([0.0] * gdim, lower, [int(n * x) for x in lower], name="block"),
            Box(corner, upper, grid, name="tool"),
        ],
        "hexahedron" if gdim == 3 else "quadrilateral",
    )
    up, names, mesh = gdim - 1, bodies.names, bodies.mesh
    facet_tags = tag_facets(
        mesh,
        [
            (BOTTOM, lambda x: np.isclose(x[up], 0.0), names["block"]),
            (BLOCK, lambda x: np.isclose(x[up], 1.0), names["block"]),
            (TOOL, lambda x: np.isclose(x[up], 1.0), names["tool"]),
            (PRESSED, lambda x: np.isclose(x[up], 1.5), names["tool"]),
        ],
        bodies.cell_tags,
    )
    V = displacement_space(mesh, degree=degree)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=bodies.cell_tags)
    a = 0
    for name, young, poisson in (("block", 1.0, nu), ("tool", 100.0, 0.0)):
        mu = young / (2 * (1 + poisson))
        lmbda = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
        shear = 2 * mu * ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v)))
        a += shear * dx(names[name])
        a += lmbda * ufl.div(u) * ufl.div(v) * dx(names[name], metadata={"quadrature_degree": 0})
    L = ufl.inner(fem.Constant(mesh, np.zeros(gdim)), v) * dx
    bcs = []
    for tag, height in ((BOTTOM, 0.0), (PRESSED, -0.02)):
        value = np.zeros(gdim)
        value[up] = height
        dofs = fem.locate_dofs_topological(V, up, facet_tags.find(tag))
        bcs.append(fem.dirichletbc(value, dofs, V))
    law = {"friction": Tresca(1e-3)} if friction else {}
    contact = ContactPair(facet_tags, slave=TOOL, master=BLOCK, **law)
    return ContactProblem(a, L, bcs=bcs, contacts=[contact], options=options)
