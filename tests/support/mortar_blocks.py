"""Two blocks on each other, meshed apart: the contact patch test for any two meshes.

A uniform pressure acts on the upper face of the upper block and on what the blocks leave free of
each other's faces. Symmetry planes let them expand and slide on each other: the stress is uniaxial
and the displacement linear in each block. With an inclined contact, pressure from all sides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from scenes import POISSON, YOUNG, at, elasticity, fixed, vector_space

import ufl
from dolfinx.fem import Constant, Function

from fenics_tfeti import ContactPair, ContactProblem, Exact
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.mortar.facets import shape_functions
from fenics_tfeti.fem.contact.mortar.integrals import integrate, integrate_alone
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.io import Box, boxes, tag_facets

PRESSURE = 2e7
LOADED, LOWER, UPPER = 1, 10, 11
SUPPORTED = (2, 3, 4)
HEIGHT = 1.0


@dataclass(frozen=True)
class Blocks:
    """The lower block is a unit square or cube; the upper one has the given width and grid."""

    cell: str
    lower: int = 5
    upper: int = 7
    width: float = 1.0
    slope: float = 0.0
    jitter: float = 0.0
    degree: int = 1

    @property
    def gdim(self) -> int:
        return 2 if self.cell in ("triangle", "quadrilateral") else 3

    def mesh(self, comm: MPI.Comm = MPI.COMM_SELF) -> Any:
        d = self.gdim
        parts = [
            Box((0.0,) * d, (1.0,) * d, (self.lower,) * (d - 1) + (2,)),
            Box(
                (0.0,) * (d - 1) + (HEIGHT,),
                (self.width,) * (d - 1) + (2.0,),
                (self.upper,) * (d - 1) + (2,),
            ),
        ]
        beams = boxes(comm, parts, self.cell)
        x = beams.mesh.geometry.x
        # inner nodes move across, the same in all layers, so that grids differ along the contact
        for body, top in ((1, 1.0), (2, 2.0)):
            nodes = np.unique(_compat.geometry_cells(beams.mesh)[beams.cell_tags.find(body)])
            span = 1.0 if body == 1 else self.width
            for axis in range(d - 1):
                wave = np.prod([np.sin(np.pi * x[nodes, k] / span) for k in range(d - 1)], axis=0)
                x[nodes, axis] += (
                    self.jitter
                    * span
                    / self.lower
                    * wave
                    * (1.5 - axis)
                    * (1.0 if body == 1 else -1.0)
                )
            below = 0.0 if body == 1 else HEIGHT
            share = (x[nodes, d - 1] - below) if body == 1 else (top - x[nodes, d - 1])
            x[nodes, d - 1] += share * self.slope * x[nodes, 0]
        return beams

    def markers(self) -> list[Any]:
        d = self.gdim

        def contact(x: Any) -> Any:
            return np.isclose(x[d - 1], HEIGHT + self.slope * x[0])

        found: list[Any] = [(SUPPORTED[axis], at(axis, 0.0)) for axis in range(d)]
        found += [(LOADED, lambda x: np.isclose(x[d - 1], 2.0))]
        if self.slope:
            found += [(LOADED, at(axis, 1.0)) for axis in range(d - 1)]
        return [*found, (LOWER, contact, 1), (UPPER, contact, 2)]


def uncovered_part(V: Any, facet_tags: Any, tag: int, other: int) -> Function:
    """Return q with int q N_k = int N_k over what `other` leaves uncovered of plane facets."""
    boundary = MeshBoundary.of(V)
    surface, master = (
        tagged_surface(boundary, facet_tags, t, "surface").gathered() for t in (tag, other)
    )
    own, over = surface.facets, master.facets
    n = len(own.points)
    mass, load = np.zeros((n, n)), np.zeros(n)
    whole, part = integrate_alone(own), integrate(own, over)
    for nodes, area in zip(own.nodes, whole.covered, strict=True):
        mass[np.ix_(nodes, nodes)] += area * mean_products(own.nodes.shape[1], V.mesh.geometry.dim)
    # the shape functions of degree 1 add up to 1
    np.add.at(load, own.nodes, whole.trace.sum(axis=1))
    np.subtract.at(load, own.nodes[part.facet], part.trace.sum(axis=1))
    values = np.linalg.solve(mass, load)
    scalar = Function(_compat.lagrange_space(V.mesh, _compat.element_facts(V)[1]))
    # by places: the two spaces may number their nodes differently
    x = scalar.function_space.tabulate_dof_coordinates()[:, : own.points.shape[1]]
    distance = np.linalg.norm(x[:, None] - surface.points[None], axis=2)
    near = distance.min(axis=1) < 1e-12
    scalar.x.array[: len(x)][near] = values[distance[near].argmin(axis=1)]
    return scalar


def mean_products(nodes: int, gdim: int) -> Any:
    """Return the mean products of the shape functions of a facet without distortion."""
    x, w = np.polynomial.legendre.leggauss(3)
    if gdim == 2:
        xi = 0.5 + 0.5 * x[:, None]
    else:
        xi = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
        w = np.outer(w, w).ravel()
        if nodes in (3, 6):
            # the square collapsed to the triangle
            r, s = 0.5 + 0.5 * xi.T
            xi, w = np.stack([r, (1 - r) * s], axis=1), w * (1 - r)
    N = shape_functions(xi, nodes)
    return np.einsum("q,qi,qj->ij", w / w.sum(), N, N)


@dataclass(frozen=True)
class PatchResult:
    """Relative errors of a solved patch test."""

    problem: ContactProblem
    displacement: float
    pressure: float


def solved(
    blocks: Blocks, slave: int = LOWER, comm: MPI.Comm = MPI.COMM_SELF, **options: Any
) -> PatchResult:
    """Solve the patch test."""
    beams = blocks.mesh(comm)
    domain, d = beams.mesh, blocks.gdim
    facet_tags = tag_facets(domain, blocks.markers(), beams.cell_tags)
    V = vector_space(domain, blocks.degree)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=domain, subdomain_data=facet_tags)
    pressure = Constant(domain, PRESSURE)
    normal = ufl.FacetNormal(domain)
    L = -pressure * ufl.inner(normal, v) * ds(LOADED)
    young = Constant(domain, YOUNG)
    kept = [pressure, young]
    for tag, other in ((LOWER, UPPER), (UPPER, LOWER)):
        free = uncovered_part(V, facet_tags, tag, other)
        kept.append(free)
        # the two faces of an inclined contact have the same footprint
        if not blocks.slope:
            L -= pressure * free * ufl.inner(normal, v) * ds(tag)
    master = LOWER + UPPER - slave
    pair = ContactPair(facet_tags, slave, master, partners="mortar", roles="given")
    problem = ContactProblem(
        elasticity(u, v, young),
        L,
        bcs=[fixed(V, facet_tags, SUPPORTED[axis], axis) for axis in range(d)],
        contacts=[pair],
        cell_tags=beams.cell_tags,
        options={"rtol": 1e-12, "subdomain_size": 150, **options},
    )
    uh = problem.solve().x.array.reshape(-1, d)
    x = V.tabulate_dof_coordinates()[:, :d]
    exact = exact_strain(d, bool(blocks.slope)) * x
    size = comm.allreduce(float(np.abs(exact).max()), MPI.MAX)
    error = comm.allreduce(float(np.abs(uh[: len(x)] - exact).max()), MPI.MAX)
    found = problem.results[0].gather().pressure
    return PatchResult(problem, error / size, float(np.abs(found / PRESSURE - 1.0).max()))


def uneven(
    blocks: Blocks,
    comm: MPI.Comm = MPI.COMM_SELF,
    slave: int = LOWER,
    pair: Mapping[str, Any] | None = None,
    geometry: Exact | None = None,
) -> ContactProblem:
    """Solve for a curved upper block, clamped blocks, and a load that grows with x."""
    problem = uneven_problem(blocks, comm, slave, pair, geometry)
    problem.solve()
    return problem


def uneven_problem(
    blocks: Blocks,
    comm: MPI.Comm = MPI.COMM_SELF,
    slave: int = LOWER,
    pair: Mapping[str, Any] | None = None,
    geometry: Exact | None = None,
) -> ContactProblem:
    """Pose the problem of `uneven`."""
    beams = blocks.mesh(comm)
    domain, d = beams.mesh, blocks.gdim
    facet_tags = tag_facets(domain, blocks.markers(), beams.cell_tags)
    x = domain.geometry.x
    nodes = np.unique(_compat.geometry_cells(domain)[beams.cell_tags.find(2)])
    middle = 0.4 * blocks.width
    lift = 0.02 * np.sum((x[nodes, : d - 1] - middle) ** 2, axis=1)
    x[nodes, d - 1] += (2.0 - x[nodes, d - 1]) * lift
    V = vector_space(domain, blocks.degree)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=domain, subdomain_data=facet_tags)
    young, pressure = Constant(domain, YOUNG), Constant(domain, 20.0 * PRESSURE)
    load = pressure * (1.0 + ufl.SpatialCoordinate(domain)[0])
    arguments = {"roles": "given", **(pair or {})}
    contact = ContactPair(facet_tags, slave, LOWER + UPPER - slave, **arguments)
    problem = ContactProblem(
        elasticity(u, v, young),
        -load * v[d - 1] * ds(LOADED),
        bcs=[
            fixed(V, facet_tags, SUPPORTED[d - 1], None),
            *(fixed(V, facet_tags, LOADED, axis) for axis in range(d - 1)),
        ],
        contacts=[contact],
        cell_tags=beams.cell_tags,
        geometry=geometry,
        options={"rtol": 1e-10, "subdomain_size": 150},
    )
    problem.kept = (young, pressure)  # dolfinx 0.5 does not keep constants alive
    return problem


def exact_strain(gdim: int, inclined: bool) -> Any:
    """Return the strains along the axes, in two dimensions for plane strain."""
    nu, unit = POISSON, PRESSURE / YOUNG
    if inclined:
        return np.full(gdim, -unit * (1 - 2 * nu) * (1.0 if gdim == 3 else 1 + nu))
    if gdim == 3:
        return unit * np.array([nu, nu, -1.0])
    return unit * np.array([nu * (1 + nu), -(1 - nu**2)])
