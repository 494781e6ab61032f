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
from scenes import POISSON, YOUNG, Scene, at

import ufl
from dolfinx.fem import Function

from fenics_tfeti import ContactProblem, Mortar
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.fem.geometry.facets import shape_functions
from fenics_tfeti.fem.geometry.integrals import integrate, integrate_alone

PRESSURE = 2e7
LOADED, LOWER, UPPER = 3, 10, 11
SUPPORTED = (1, 2, 4)
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

    def scene(self, comm: MPI.Comm = MPI.COMM_SELF, marks: Any = None, **more: Any) -> Scene:
        """Mesh the blocks; tags are those of the faces before they are inclined."""
        up = self.gdim - 1
        parts = [
            ((0.0,) * (up + 1), (1.0,) * (up + 1), (self.lower,) * up + (2,)),
            ((0.0,) * up + (HEIGHT,), (self.width,) * up + (2.0,), (self.upper,) * up + (2,)),
        ]
        if marks is None:
            marks = [(SUPPORTED[axis], at(axis, 0.0)) for axis in range(up + 1)]
            marks += [(LOADED, at(up, 2.0))]
            marks += [(LOADED, at(axis, 1.0)) for axis in range(up) if self.slope]
            marks += self.contact
        scene = Scene.of_boxes(comm, self.cell, parts, marks, degree=self.degree, **more)
        x = scene.mesh.geometry.x
        # inner nodes move across, the same in all layers, so that grids differ along the contact
        for body, span, sign in ((1, 1.0, 1.0), (2, self.width, -1.0)):
            nodes = scene.nodes(body)
            wave = np.prod(np.sin(np.pi * x[nodes, :up] / span), axis=1)
            size = sign * self.jitter * span / self.lower * (1.5 - np.arange(up))
            x[nodes, :up] += np.outer(wave, size)
            share = 1.0 - np.abs(x[nodes, up] - HEIGHT)
            x[nodes, up] += share * self.slope * x[nodes, 0]
        return scene

    @property
    def contact(self) -> list[Any]:
        """The marks of the surfaces that touch."""
        return [(LOWER, at(self.gdim - 1, HEIGHT), 1), (UPPER, at(self.gdim - 1, HEIGHT), 2)]


def uncovered_part(scene: Scene, tag: int, other: int) -> Function:
    """Return q with int q N_k = int N_k over what `other` leaves uncovered of plane facets."""
    V, boundary = scene.V, MeshBoundary.of(scene.V)
    surface, master = (
        tagged_surface(boundary, scene.facet_tags, t, "surface").gathered() for t in (tag, other)
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
    scene, d = blocks.scene(comm), blocks.gdim
    scene.add_load(LOADED, -PRESSURE)
    # the two faces of an inclined contact have the same footprint
    for tag, other in [] if blocks.slope else [(LOWER, UPPER), (UPPER, LOWER)]:
        scene.add_load(tag, -PRESSURE * uncovered_part(scene, tag, other))
    for axis in range(d):
        scene.fix(SUPPORTED[axis], axis)
    scene.add_pair(slave, LOWER + UPPER - slave, partners=Mortar(), roles="given")
    problem = scene.problem(options={"rtol": 1e-12, "subdomain_size": 150, **options})
    uh = problem.solve().x.array.reshape(-1, d)
    x = scene.V.tabulate_dof_coordinates()[:, :d]
    exact = exact_strain(d, bool(blocks.slope)) * x
    size = comm.allreduce(float(np.abs(exact).max()), MPI.MAX)
    error = comm.allreduce(float(np.abs(uh[: len(x)] - exact).max()), MPI.MAX)
    found = problem.results[0].gather().pressure
    return PatchResult(problem, error / size, float(np.abs(found / PRESSURE - 1.0).max()))


def uneven_scene(
    blocks: Blocks,
    comm: MPI.Comm = MPI.COMM_SELF,
    slave: int = LOWER,
    pair: Mapping[str, Any] | None = None,
) -> Scene:
    """Return a curved upper block on a lower one, clamped both, and a load that grows with x."""
    scene, d = blocks.scene(comm), blocks.gdim
    x, nodes = scene.mesh.geometry.x, scene.nodes(2)
    lift = 0.02 * np.sum((x[nodes, : d - 1] - 0.4 * blocks.width) ** 2, axis=1)
    x[nodes, d - 1] += (2.0 - x[nodes, d - 1]) * lift
    scene.traction = scene.constant(20.0 * PRESSURE)
    load = scene.traction * (1.0 + ufl.SpatialCoordinate(scene.mesh)[0])
    scene.L = -load * scene.v[d - 1] * scene.ds(LOADED)
    scene.fix(SUPPORTED[d - 1])
    for axis in range(d - 1):
        scene.fix(LOADED, axis)
    scene.add_pair(slave, LOWER + UPPER - slave, **{"roles": "given", **(pair or {})})
    return scene


def uneven_problem(blocks: Blocks, *of_scene: Any, gaps: Any = None) -> ContactProblem:
    """Pose the problem of `uneven_scene`."""
    options = {"rtol": 1e-10, "subdomain_size": 150}
    return uneven_scene(blocks, *of_scene).problem(gaps=gaps, options=options)


def uneven(blocks: Blocks, *of_scene: Any, gaps: Any = None) -> ContactProblem:
    """Solve the problem of `uneven_scene`."""
    problem = uneven_problem(blocks, *of_scene, gaps=gaps)
    problem.solve()
    return problem


def exact_strain(gdim: int, inclined: bool) -> Any:
    """Return the strains along the axes, in two dimensions for plane strain."""
    nu, unit = POISSON, PRESSURE / YOUNG
    if inclined:
        return np.full(gdim, -unit * (1 - 2 * nu) * (1.0 if gdim == 3 else 1 + nu))
    if gdim == 3:
        return unit * np.array([nu, nu, -1.0])
    return unit * np.array([nu * (1 + nu), -(1 - nu**2)])
