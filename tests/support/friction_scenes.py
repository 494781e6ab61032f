"""Contact problems with friction, as a user would write them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from scenes import at, dimension, elasticity, fixed, vector_space

import ufl
from dolfinx.fem import Constant

from fenics_tfeti import ContactPair, ContactProblem, Plane, RigidObstacle, Tresca
from fenics_tfeti.io import Box, boxes, tag_facets

CLAMPED, LOADED, SLAVE, MASTER, TOP = 1, 3, 5, 6, 4


@dataclass
class Rubbing:
    """A problem, and the traction [Pa] on its loaded surface."""

    problem: ContactProblem
    traction: Any
    tags: Any


def pushed_cube(
    cell: str,
    n: int = 4,
    lower: int | None = None,
    friction: Any = None,
    push: tuple[float, float] = (0.03, 0.009),
    press: float = 0.1,
    comm: MPI.Intracomm = MPI.COMM_SELF,
    degree: int = 1,
    young: float = 1.0,
    **arguments: Any,
) -> Rubbing:
    """Return a unit cube (square) on a rigid plane, or on a cube of `lower` elements an edge.

    Its top is pressed and pushed sideways.
    """
    d = dimension(cell)
    parts = [Box((0.0,) * d, (1.0,) * d, (n,) * d, "upper")]
    marks = [(SLAVE, at(d - 1, 0.0), 1), (LOADED, at(d - 1, 1.0), 1)]
    if lower:
        parts += [Box((*(0.0,) * (d - 1), -1.0), (*(1.0,) * (d - 1), 0.0), (lower,) * d, "lower")]
        marks += [(MASTER, at(d - 1, 0.0), 2), (CLAMPED, at(d - 1, -1.0), 2)]
    tagged = boxes(comm, parts, cell)
    tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
    V = vector_space(tagged.mesh, degree)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    traction = Constant(tagged.mesh, np.array([*push[: d - 1], -press]))
    ds = ufl.Measure("ds", domain=tagged.mesh, subdomain_data=tags)
    friction = Tresca(0.05) if friction is None else friction
    if lower:
        contact: Any = ContactPair(tags, SLAVE, MASTER, friction=friction)
    else:
        ground = Plane((0.0,) * d, (*(0.0,) * (d - 1), 1.0))
        contact = RigidObstacle(tags, SLAVE, ground, friction=friction)
    problem = ContactProblem(
        elasticity(u, v, young),
        ufl.inner(traction, v) * ds(LOADED),
        [fixed(V, tags, CLAMPED, None)] if lower else [],
        [contact],
        tagged.cell_tags,
        **{"options": {"rtol": 1e-8}, **arguments},
    )
    return Rubbing(problem, traction, tags)


THICKNESS, SHEAR_STRENGTH = 0.02, 1e-4


def pulled_strip(n: int = 50, comm: MPI.Intracomm = MPI.COMM_SELF) -> Rubbing:
    """Return a plane strip of length 1 on a rigid line, pulled at x = 1; E = 1, nu = 0.

    Its top moves along it only, so that it does not bend.
    """
    strip = boxes(comm, [Box((0, 0), (1, THICKNESS), (n, 2))], "quadrilateral")
    marks = [(SLAVE, at(1, 0.0)), (LOADED, at(0, 1.0)), (TOP, at(1, THICKNESS))]
    tags = tag_facets(strip.mesh, marks)
    V = vector_space(strip.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    traction = Constant(strip.mesh, np.zeros(2))
    ds = ufl.Measure("ds", domain=strip.mesh, subdomain_data=tags)
    ground = RigidObstacle(
        tags, SLAVE, Plane((0, 0), (0, 1)), friction=Tresca(SHEAR_STRENGTH), name="ground"
    )
    strain = ufl.sym(ufl.grad(u))
    problem = ContactProblem(
        ufl.inner(strain, ufl.grad(v)) * ufl.dx,
        ufl.inner(traction, v) * ds(LOADED),
        [fixed(V, tags, TOP, 1)],
        [ground],
        options={"rtol": 1e-6, "subdomain_size": 60},
    )
    return Rubbing(problem, traction, tags)
