"""Rubber under pressures that follow its surface, and what is known about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import scenes
import scipy.sparse as sp
from scenes import at
from scipy.integrate import solve_bvp
from scipy.sparse.linalg import spsolve

import ufl
from dolfinx import fem
from dolfinx.fem import petsc

from fenics_tfeti import NonlinearContactProblem, Plane
from fenics_tfeti.models import follower_pressure

INNER, OUTER, FIRST, LAST, BELOW, ABOVE = 1, 2, 3, 4, 5, 6
YOUNG, POISSON = 1.0, 0.4


@dataclass(frozen=True)
class Pressurised:
    """A problem, its residual, its displacement and its pressure."""

    problem: NonlinearContactProblem
    F: ufl.Form
    u: fem.Function
    pressure: fem.Constant
    set_load: Callable[[float], None]


def tube(
    kind: str = "plane",
    degree: int = 1,
    n: int = 4,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    energy: Callable[[Any], Any] | None = None,
) -> Pressurised:
    """Make a quarter of a tube of radii 1 and 2 that keeps its length: plane, in space, or r, z.

    Another energy, a form, may take the place of the usual one where the tube is a quarter.
    """
    dim, is_quarter = (3, True) if kind == "space" else (2, kind == "plane")
    cell = {2: "quadrilateral", 3: "hexahedron"}[dim]
    low, high = np.zeros(dim), np.append([1.0, 1.0], [0.25] * (dim - 2))
    cells = (n, 2 * n if is_quarter else 1, 1)[:dim]
    marks = [(INNER, at(0, 0.0)), (OUTER, at(0, 1.0)), (FIRST, at(1, 0.0)), (LAST, at(1, 1.0))]
    if dim == 3:
        marks += [(BELOW, at(2, 0.0)), (ABOVE, at(2, 0.25))]

    def bent(x: Any) -> Any:
        radius, angle = 1.0 + x[0], 0.5 * np.pi * x[1]
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), *x[2:]])

    def shifted(x: Any) -> Any:
        return np.stack([1.0 + x[0], 0.25 * x[1]])

    shape = bent if is_quarter else shifted
    body = scenes.Scene.of_boxes(comm, cell, [(low, high, cells)], marks, shape, degree=degree)
    u, p = fem.Function(body.V), fem.Constant(body.mesh, 0.0)
    body.fix(FIRST, 1)
    body.fix(LAST, 0 if is_quarter else 1)
    if dim == 3:
        body.fix(BELOW, 2)
        body.fix(ABOVE, 2)
    r, H = ufl.SpatialCoordinate(body.mesh)[0], ufl.grad(u)
    G, weight = ufl.Identity(dim) + H, 1.0
    if not is_quarter:
        weight = 2 * ufl.pi * r
        G = ufl.as_tensor(
            [[1 + H[0, 0], H[0, 1], 0], [H[1, 0], 1 + H[1, 1], 0], [0, 0, 1 + u[0] / r]]
        )
    dx = ufl.dx(metadata={"quadrature_degree": 2 * degree})
    W = energy(u) if energy else weight * _energy(G, YOUNG, POISSON) * dx
    F = ufl.derivative(W, u, body.v) + follower_pressure(p, u, body.ds(INNER), weight)
    options = {"newton_rtol": 1e-9, "subdomain_size": 60}
    problem = NonlinearContactProblem(F, u, bcs=body.bcs, measure_weight=weight, options=options)
    return Pressurised(problem, F, u, p, lambda part: setattr(p, "value", 0.14 * part))


def strip(degree: int = 1, comm: MPI.Intracomm = MPI.COMM_WORLD) -> Pressurised:
    """Make a strip, clamped at one end, that the pressure on its upper side bends.

    The surface that is loaded ends freely: the tangent is not symmetric.
    """
    marks = [(FIRST, at(0, 0.0)), (ABOVE, at(1, 1.0))]
    box = (0, 0), (4, 1), (16 // degree, 4 // degree)
    body = scenes.Scene.of_boxes(comm, "quadrilateral", [box], marks, degree=degree)
    u, p = fem.Function(body.V), fem.Constant(body.mesh, 0.0)
    body.fix(FIRST)
    W = _energy(ufl.Identity(2) + ufl.grad(u), YOUNG, POISSON)
    F = ufl.derivative(W * ufl.dx(metadata={"quadrature_degree": 2 * degree}), u, body.v)
    F += follower_pressure(p, u, body.ds(ABOVE))
    options = {"newton_rtol": 1e-9, "subdomain_size": 60}
    problem = NonlinearContactProblem(F, u, bcs=body.bcs, options=options)
    return Pressurised(problem, F, u, p, lambda part: setattr(p, "value", 4e-3 * part))


def _energy(G: Any, young: float, nu: float, dilatation: float = 1.0) -> Any:
    mu, lmbda = young / (2 * (1 + nu)), dilatation * young * nu / ((1 + nu) * (1 - 2 * nu))
    log = ufl.ln(ufl.det(G))
    return mu / 2 * (ufl.inner(G, G) - G.ufl_shape[0]) - mu * log + lmbda / 2 * log**2


def pressure_on_incompressible_tube(opening: float) -> float:
    """Return the pressure at a radial displacement of the inner surface, for E = 1.

    The integral of mu (lambda^2 + 1) / lambda^3 over the stretches of the circumference.
    """
    inner, outer = 1.0 + opening, np.sqrt(4.0 + (1.0 + opening) ** 2 - 1.0) / 2.0
    return float(YOUNG / 3.0 * (np.log(inner / outer) + 0.5 * (outer**-2 - inner**-2)))


def opening_of_tube(pressure: float) -> float:
    """Return the radial displacement of the inner surface, by a boundary value problem."""
    mu, lmbda = YOUNG / (2 * (1 + POISSON)), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))

    def stress(stretch: Any, other: Any) -> Any:
        return mu * (stretch - 1 / stretch) + lmbda * np.log(stretch * other) / stretch

    def stretch_of(radial: Any, hoop: Any) -> Any:
        stretch = 1.0 / hoop
        for _ in range(50):
            slope = mu * (1 + stretch**-2) + lmbda * (1 - np.log(stretch * hoop)) / stretch**2
            stretch = stretch - (stress(stretch, hoop) - radial) / slope
        return stretch

    def change(R: Any, y: Any) -> Any:
        hoop = y[0] / R
        radial = stretch_of(y[1], hoop)
        return np.stack([radial, (stress(hoop, radial) - y[1]) / R])

    def ends(inner: Any, outer: Any) -> Any:
        # the pressure acts over the present area
        return np.array([inner[1] + pressure * inner[0], outer[1]])

    R = np.linspace(1.0, 2.0, 50)
    y = np.stack([R + 0.3 / R, 0.1 * (R - 2.0)])
    solution = solve_bvp(change, ends, R, y, tol=1e-8, max_nodes=10**4)
    assert solution.success
    return float(solution.sol(1.0)[0] - 1.0)


def newton_with_lu(scene: Pressurised, rtol: float = 1e-9) -> tuple[Any, int]:
    """Return displacements and steps from zero with the whole unsymmetric tangent; serial only."""
    V = scene.u.function_space
    u = fem.Function(V)
    F = ufl.replace(scene.F, {scene.u: u})
    residual, tangent = fem.form(F), fem.form(ufl.derivative(F, u, ufl.TrialFunction(V)))
    prescribed = scenes.reference.prescribed_values(V, scene.problem.bcs)
    free, first = np.flatnonzero(np.isnan(prescribed)), 0.0
    for step in range(20):
        r = fem.assemble_vector(residual).array[free]
        first = first or np.linalg.norm(r)
        if np.linalg.norm(r) <= rtol * first:
            return u.x.array, step
        K = petsc.assemble_matrix(tangent)
        K.assemble()
        indptr, indices, data = K.getValuesCSR()
        K = sp.csr_matrix((data, indices, indptr))[free][:, free]
        u.x.array[free] -= spsolve(K.tocsc(), r)
    raise AssertionError("not converged")


def seal(
    degree: int = 1, n: int = 6, comm: MPI.Intracomm = MPI.COMM_WORLD, **options: Any
) -> Pressurised:
    """Make rubber of E = 6 MPa that a lid squeezes by 15 %, and 30 MPa press towards a wall.

    Nothing but contact with floor, lid and wall holds it. Loads are 1 and 2.
    """
    marks = [(INNER, at(0, 0.0)), (OUTER, at(0, 1.0)), (BELOW, at(1, 0.0)), (ABOVE, at(1, 1.0))]
    body = scenes.Scene.of_boxes(
        comm, "quadrilateral", [((0, 0), (1, 1), (n, n))], marks, degree=degree
    )
    u, p, height = fem.Function(body.V), fem.Constant(body.mesh, 0.0), {"now": 1.0}
    G, shear = ufl.Identity(2) + ufl.grad(u), ufl.dx(metadata={"quadrature_degree": 2 * degree})
    volumetric = ufl.dx(metadata={"quadrature_degree": 2 * (degree - 1)})
    of_volume = _energy(G, 6e6, 0.49) - _energy(G, 6e6, 0.49, 0.0)
    W = _energy(G, 6e6, 0.49, 0.0) * shear + of_volume * volumetric
    body.add_obstacle(BELOW, Plane((0, 0), (0, 1)))
    body.add_obstacle(ABOVE, lambda x: Plane((0, height["now"]), (0, -1))(x))
    body.add_obstacle(OUTER, Plane((1.05, 0), (-1, 0)))

    def set_load(part: float) -> None:
        height["now"], p.value = 1.0 - 0.15 * min(part, 1.0), 30e6 * max(part - 1.0, 0.0)

    F = ufl.derivative(W, u, body.v) + follower_pressure(p, u, body.ds(INNER))
    problem = NonlinearContactProblem(F, u, contacts=body.contacts, options=options)
    return Pressurised(problem, F, u, p, set_load)
