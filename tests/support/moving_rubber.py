"""Rubber in motion at finite strains, by energy-momentum steps."""

from mpi4py import MPI

import numpy as np
import scenes
from scenes import at

import ufl
from dolfinx import fem

from fenics_tfeti import NonlinearContactProblem, Plane
from fenics_tfeti.models import (
    EnergyMomentumStep,
    neo_hookean_of_strain,
    redistributed_density,
)

BOTTOM, FLOOR, MOVING = 1, 2, 1


class Motion:
    """Blocks of height 1 that move; the first one towards a floor, or towards the second one."""

    def __init__(
        self,
        dim=2,
        floor=None,
        dt=0.05,
        n=4,
        comm=MPI.COMM_SELF,
        mass="moved",
        load=None,
        **options,
    ):
        """Take the floor: None, "plane" or "block"."""
        low, high = np.full(dim, -0.5), np.full(dim, 0.5)
        low[-1], high[-1] = 0.02, 1.02
        parts = [(low, high, (n,) * dim)]
        marks = [(BOTTOM, at(dim - 1, 0.02), MOVING)]
        if floor == "block":
            below = np.eye(dim)[-1] * 1.02
            parts.append((low - below, high - below, (n + 1,) * (dim - 1) + (n,)))
            marks.append((FLOOR, at(dim - 1, 0.0), 2))
        cell = {2: "quadrilateral", 3: "hexahedron"}[dim]
        self.bodies = bodies = scenes.Scene.of_boxes(comm, cell, parts, marks)
        if floor == "plane":
            bodies.add_obstacle(BOTTOM, Plane(np.zeros(dim), np.eye(dim)[-1]))
        if floor == "block":
            bodies.add_pair(BOTTOM, FLOOR)
        density = 1.0
        if floor and mass == "moved":
            density = redistributed_density(bodies.mesh, 1.0, bodies.contacts)
        self.u = fem.Function(bodies.V)
        self.step = EnergyMomentumStep(neo_hookean_of_strain(1.0, 0.3), self.u, density, dt)
        F = self.step.F
        if load is not None:
            F -= ufl.inner(bodies.constant(np.array(load)), bodies.v) * ufl.dx
        self.problem = NonlinearContactProblem(
            F, self.u, contacts=bodies.contacts, options={"newton_rtol": 1e-10, **options}
        )
        self._density, self.dim = density, dim

    def throw(self, velocity):
        """Set the velocity of the first block, a function of x."""
        V, mesh = self.bodies.V, self.bodies.mesh
        thrown = fem.Function(V)
        thrown.interpolate(lambda x: velocity(x)[: self.dim])
        mesh.topology.create_connectivity(self.dim, self.dim)
        cells = self.bodies.cell_tags.find(MOVING)
        dofs = fem.locate_dofs_topological(V, self.dim, cells)
        blocks = np.add.outer(self.dim * dofs, np.arange(self.dim)).ravel()
        self.step.v.x.array[blocks] = thrown.x.array[blocks]

    def advance(self):
        self.problem.solve()
        self.problem.advance()
        self.step.advance()

    def momenta(self, body=None):
        """Return momentum and angular momentum of all bodies, or of one."""
        x, v = ufl.SpatialCoordinate(self.bodies.mesh) + self.step.u0, self.step.v
        dx = self.bodies.dx(metadata={"quadrature_degree": 2})
        dx = dx if body is None else dx(body)
        pairs = [(0, 1)] if self.dim == 2 else [(1, 2), (2, 0), (0, 1)]
        parts = [*v, *(x[i] * v[j] - x[j] * v[i] for i, j in pairs)]
        # one form for all of them
        chosen = self.bodies.constant(np.zeros(len(parts)))
        form = fem.form(self._density * ufl.inner(chosen, ufl.as_vector(parts)) * dx)
        momenta = []
        for chosen.value[:] in np.eye(len(parts)):
            momenta.append(self.bodies.mesh.comm.allreduce(fem.assemble_scalar(form)))
        return np.array(momenta)
