"""Bodies in motion, by the time steps of the page about impact."""

from mpi4py import MPI

import numpy as np
from msh_files import gmsh_model

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import redistributed_density, small_strain


class Motion:
    """Newmark's method with the alpha of Wood, Bossak and Zienkiewicz."""

    def __init__(self, problem_of, elastic, inertia, V, dt, alpha=-0.05, load=None):
        """Take `elastic(u, w)` and `inertia(a, w)`, forms; a problem is made of the sum's."""
        self.V, self.dt, self.alpha = V, float(dt), alpha
        self.beta, self.gamma = (1 - alpha) ** 2 / 4, 1 / 2 - alpha
        self.u, self.v, self.a = (fem.Function(V) for _ in range(3))
        u, w = ufl.TrialFunction(V), ufl.TestFunction(V)
        a = (1 - alpha) * self.acceleration(u, self.u, self.v, self.a) + alpha * self.a
        residual = elastic(u, w) + inertia(a, w)
        if load is not None:
            residual -= load(w)
        self.problem = problem_of(ufl.lhs(residual), ufl.rhs(residual))
        self._energies = [fem.form(elastic(self.u, self.u)), fem.form(inertia(self.v, self.v))]

    def acceleration(self, u, u0, v0, a0):
        return (u - u0 - self.dt * v0) / (self.beta * self.dt**2) - (1 / (2 * self.beta) - 1) * a0

    def step(self):
        """Advance by one time step; return the contact force."""
        u = self.problem.solve().x.array.copy()
        u0, v0, a0 = (f.x.array for f in (self.u, self.v, self.a))
        a = self.acceleration(u, u0, v0, a0)
        v0 += self.dt * ((1 - self.gamma) * a0 + self.gamma * a)
        u0[:], a0[:] = u, a
        self.problem.advance()
        return self.problem.report.contacts[0].normal_force

    @property
    def energy(self):
        return sum(self.total(form) for form in self._energies) / 2

    def total(self, form):
        return self.V.mesh.comm.allreduce(fem.assemble_scalar(form))


SPEED = 1e-3  # of the bar that moves, where waves have 1


def two_bars(n, courant, alpha=-0.05, comm=MPI.COMM_SELF, options=None):
    """Return two equal bars of length, modulus and density 1, the left one moving to the right.

    And the momentum of each, and the thickness of the bars.
    """
    h = 1 / n
    bars = [Box((-1, 0), (0, h), (n, 1)), Box((0, 0), (1, h), (n, 1))]
    bodies = boxes(comm, bars, "quadrilateral")
    mesh = bodies.mesh
    ends = [(1, lambda x: np.isclose(x[0], 0), 1), (2, lambda x: np.isclose(x[0], 0), 2)]
    tags = tag_facets(mesh, ends, bodies.cell_tags)
    V, dx = displacement_space(mesh), ufl.Measure("dx", mesh, subdomain_data=bodies.cell_tags)
    contacts = [ContactPair(tags, 1, 2)]
    rho = redistributed_density(mesh, 1.0, contacts)
    motion = Motion(
        lambda a, L: ContactProblem(a, L, contacts=contacts, options=options),
        lambda u, w: ufl.inner(small_strain(u), small_strain(w)) * dx((1, 2)),
        lambda a, w: rho * ufl.inner(a, w) * dx((1, 2)),
        V,
        courant * h,
        alpha,
    )
    V.mesh.topology.create_connectivity(2, 2)
    moving = fem.locate_dofs_topological(V.sub(0), 2, bodies.cell_tags.find(1))
    motion.v.x.array[moving] = SPEED
    momenta = [fem.form(rho * motion.v[0] * dx(body)) for body in (1, 2)]
    return motion, momenta, h


def draw_meridian(path, radius, size, patch):
    """Mesh half of a disc that touches the plane y = 0, with elements of a size near the pole."""
    with gmsh_model(path, 2) as gmsh:
        occ, mesh = gmsh.model.occ, gmsh.model.mesh
        disc = occ.addDisk(0, radius, 0, radius, radius)
        occ.intersect([(2, disc)], [(2, occ.addRectangle(0, 0, 0, radius, 2 * radius))])
        occ.synchronize()
        field, away = mesh.field.add("MathEval"), f"(sqrt(x^2+y^2)-{patch})"
        mesh.field.setString(field, "F", f"{size}+0.1*({away}+abs({away}))")
        mesh.field.setAsBackgroundMesh(field)
        for option in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints"):
            gmsh.option.setNumber(f"Mesh.{option}", 0)
        body = gmsh.model.addPhysicalGroup(2, [tag for _, tag in gmsh.model.getEntities(2)])
        gmsh.model.setPhysicalName(2, body, "ball")
