"""The certificate against direct solutions: the bound holds, and is not far from the error."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.linalg
from friction_problems import blocks_that_do_not_match, pushed_block
from pairwise import pairwise
from torn import column, in_units, with_fields, with_prescribed

from fenics_tfeti.feti import Options, TornSolver, TornSystem
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.solution.certificate import BodyError, Certificate, GroupError
from fenics_tfeti.feti.solution.certifier import Certifier
from fenics_tfeti.feti.solution.recovery import Recovered, balance_multipliers, recover_displacement

pytestmark = pytest.mark.once


def scaled(system: TornSystem, body: int, factor: float) -> TornSystem:
    """Return the system with the stiffness of one body multiplied by a factor."""
    parts = [
        replace(s, stiffness=factor * s.stiffness) if s.body == body else s
        for s in system.subdomains
    ]
    return replace(system, subdomains=parts)


def bent(load=(0.02, 0.01, -1.0)) -> TornSystem:
    """Return a column whose upper body is loaded at one corner, so that the contact opens."""
    system = column(n=3, height=2, load=load)
    *others, upper = system.subdomains
    force = upper.load.copy().reshape(-1, 3)
    force[np.argmax(upper.coordinates.sum(axis=1))] += [0.0, 0.0, 0.3]
    return replace(system, subdomains=[*others, replace(upper, load=force.ravel())])


SYSTEMS = {
    "column": column(n=3, load=(0, 0, -1.0)),
    "bent": bent(),
    "soft on stiff": scaled(bent(), 1, 1e-6),
    "stiff on soft": scaled(bent(), 1, 1e6),
    "micro": replace(
        bent(),
        subdomains=[
            replace(s, stiffness=1e5 * s.stiffness, load=1e-9 * s.load) for s in bent().subdomains
        ],
    ),
}


# Of the direct solution: rounding in the entries of K makes the rigid motions of the stiff body
# cost some 1e-8 of the energy of the soft one; for the package they cost nothing.
ACCURACY = {"stiff on soft": 1e-7}


def stiffness(system: TornSystem) -> np.ndarray:
    return scipy.linalg.block_diag(*(s.stiffness.toarray() for s in system.subdomains))


@cache
def exact(name: str) -> np.ndarray:
    """Return the torn displacement by dense elimination of the rows that are known to be active."""
    system = SYSTEMS[name]
    solver = TornSolver(system, Options(rtol=1e-9))
    active = solver.solve().multipliers > 0.0
    constraints = solver.setup.constraints
    rows = constraints.equality | active
    B, c = constraints.matrix.toarray()[rows], solver.data.c[rows]
    # u = D^{-1}B'c + D^{-1/2} N y: as BD^{-1}B' = I, all is in units of the local stiffness
    d = 1.0 / np.sqrt(constraints.weights)
    N = d[:, None] * scipy.linalg.null_space(B * d)
    K, f = stiffness(system), np.concatenate([s.load for s in system.subdomains])
    factor = scipy.linalg.cho_factor(N.T @ K @ N)
    u = (d**2 * (B.T @ c)).astype(np.longdouble)
    for _ in range(4):  # residuals in extended precision: stiff bodies move almost rigidly
        residual = f - K.astype(np.longdouble) @ u
        u = u + N @ scipy.linalg.cho_solve(factor, (N.T @ residual).astype(float))
    force, u = B @ (d**2 * residual).astype(float), u.astype(float)
    assert force[np.isin(np.flatnonzero(rows), constraints.inequality)].min() > 0.0
    jump = constraints.matrix @ u - solver.data.c
    assert jump[constraints.inequality].max() < 1e-9 * np.abs(u).max()
    return u


def energy_norm(system: TornSystem, u: np.ndarray) -> float:
    return float(np.sqrt(u @ stiffness(system) @ u))


WAYS = [
    {},
    {"preconditioner": "dirichlet"},
    {"method": "smalbe"},
    {"method": "smalbe", "preconditioner": "none", "mprgp_expansion": "standard"},
]


@pytest.mark.parametrize(
    ("name", "options", "rtol"), pairwise(SYSTEMS, WAYS, [1e-2, 1e-4, 1e-6, 1e-9])
)
def test_bound_holds_and_is_sharp(name, options, rtol):
    """1 <= bound / error <= 10, up to the accuracy of the direct solution."""
    system = SYSTEMS[name]
    solution = TornSolver(system, Options(rtol=rtol, **options)).solve()
    u = np.concatenate(solution.displacements)
    bound = solution.report.certificate.error * energy_norm(system, u)
    error = energy_norm(system, u - exact(name))
    accuracy = ACCURACY.get(name, 1e-10) * energy_norm(system, u)
    assert error - accuracy <= bound <= 10.0 * error + accuracy
    assert bound <= max(rtol, 1e-9) * energy_norm(system, u)


@pytest.mark.parametrize("name", SYSTEMS)
def test_constraints_hold_to_rounding(name):
    """Already at rtol 1e-2 nothing is torn, penetrated or open where it presses."""
    solver = TornSolver(SYSTEMS[name], Options(rtol=1e-2))
    solution = solver.solve()
    constraints, u = solver.setup.constraints, np.concatenate(solution.displacements)
    jump = constraints.matrix @ u - solver.data.c
    negligible = 1e-13 * np.abs(constraints.matrix @ np.diag(u)).sum(axis=1).max()
    assert np.abs(jump[constraints.equality]).max() <= negligible
    contact = jump[constraints.inequality]
    assert contact.max() <= negligible
    pressing = solution.multipliers[constraints.inequality] > 0.0
    assert np.abs(contact[pressing]).max() <= negligible


@pytest.mark.parametrize("name", ["soft on stiff", "stiff on soft"])
@pytest.mark.parametrize("rtol", [1e-3, 1e-6])
def test_each_body_is_as_accurate_as_asked(name, rtol):
    """The true error of each body relative to its own energy, or 1e-3 of its group's."""
    system = SYSTEMS[name]
    solution = TornSolver(system, Options(rtol=rtol)).solve()
    u, K = np.concatenate(solution.displacements), stiffness(system)
    body = np.repeat([s.body for s in system.subdomains], [s.size for s in system.subdomains])
    for b in (0, 1):
        at = body == b
        difference = (u - exact(name))[at]
        error = np.sqrt(difference @ K[np.ix_(at, at)] @ difference)
        scale = max(np.sqrt(u[at] @ K[np.ix_(at, at)] @ u[at]), 1e-3 * energy_norm(system, u))
        assert error <= 2.0 * rtol * scale


def test_rigid_motion_of_any_size_changes_nothing():
    """Both bodies moved along x by 10^6 times their deformation: the same products and errors."""
    reports, system = [], SYSTEMS["bent"]
    for shift in (0.0, 1e6):
        values = np.where(system.prescribed.components == 0, shift, 0.0)
        moved = with_fields(system, "prescribed", values=values)
        reports.append(TornSolver(moved, Options(rtol=1e-4)).solve().report)
    assert abs(reports[0].products["total"] - reports[1].products["total"]) <= 1
    errors = [report.certificate.error for report in reports]
    assert errors[1] == pytest.approx(errors[0], rel=0.5)


def test_bodies_that_do_not_touch_are_groups_of_their_own():
    """The upper body is pulled off, by springs against its own weight, and moves alone."""
    system = bent(load=(0, 0, 0.0))
    top = system.subdomains[-1]
    high = top.nodes[np.isclose(top.coordinates[:, 2], 3)]
    lifted = with_prescribed(system, high, [2], 5.0)
    certificate = TornSolver(lifted).solve().report.certificate
    assert [group.bodies for group in certificate.groups] == [["lower"], ["upper"]]


def test_body_at_rest_beside_a_loaded_one_needs_nothing():
    system = column(contact=True, load=(0, 0, -1.0))
    far = [
        replace(s, nodes=s.nodes + 10**10, coordinates=s.coordinates + 50.0, body=2)
        for s in system.subdomains[:2]
    ]
    bottom = far[0].nodes[np.isclose(far[0].coordinates[:, 2], 50.0)]
    both = replace(system, subdomains=[*system.subdomains, *far])
    both = with_prescribed(both, bottom, [0, 1, 2])
    certificate = TornSolver(both, Options(rtol=1e-9)).solve().report.certificate
    assert certificate.groups[1].error == 0.0
    assert certificate.bodies[2].error == 0.0


def recovered_from(
    solver: TornSolver, multipliers: np.ndarray
) -> tuple[Recovered, np.ndarray, CoarseSpace]:
    """Return the displacements that follow from multipliers, these balanced, and G."""
    data, setup = solver.data, solver.setup
    multipliers, projector = balance_multipliers(
        setup.projector.coarse_space, data.e, multipliers, data.radius
    )
    recovered = recover_displacement(
        setup.F, projector, data.load, data.c, multipliers, setup.local.unit
    )
    return recovered, multipliers, projector.coarse_space


def certificate_of(solver: TornSolver, multipliers: np.ndarray) -> Certificate:
    """Return the certificate of multipliers, and of the displacements that follow from them."""
    problem = Certifier(solver.setup, solver.data, solver.system.body_names)
    return problem.certify(*recovered_from(solver, multipliers))[0]


def test_no_bound_where_contact_forces_do_not_balance_the_load():
    """Without them the dual value is minus infinity, however little u_t is torn."""
    solver = TornSolver(column(n=2, load=(0, 0, -1.0)))
    solution = solver.solve()
    multipliers = solution.multipliers.copy()
    multipliers[solver.setup.constraints.inequality] = 0.0
    certificate = certificate_of(solver, multipliers)
    assert [body.error for body in certificate.bodies][1] == np.inf
    assert certificate.bound == np.inf


@pytest.mark.parametrize("part", [0.9, 1.0])
def test_no_bound_where_friction_at_its_bounds_does_not_balance_the_load(part):
    """Where all sites slip there is one only if their forces balance the load."""
    n, bound = 3, 0.01
    solver = TornSolver(pushed_block(n, (part * (n + 1) ** 2 * bound, 0.0, -1.0), bound))
    friction, multipliers = solver.setup.constraints.friction, solver.data.feasible.copy()
    way = np.sign(friction.at_sites(multipliers)[:, 0].sum())
    forces = np.stack([way * solver.data.radius, np.zeros(friction.size)], axis=1)
    certificate = certificate_of(solver, friction.with_sites(multipliers, forces))
    assert np.isfinite(certificate.bound) == (part == 1.0)


@pytest.mark.parametrize(("part", "relative"), [(1e-3, 0.5), (1e-6, 0.5), (1e-8, 0.5e-2), (0.0, 0)])
def test_errors_of_nearly_unloaded_bodies_are_bounded_absolutely(part, relative):
    """A body with a small part of the energy norm of all has half of it as its error."""
    groups = [GroupError(["large"], 1.0, 1e-9), GroupError(["small"], part, 0.5)]
    bodies = [BodyError("large", 1.0, 1e-9, 1.0), BodyError("small", part, 0.5, part)]
    certificate = Certificate(0.0, 0.0, groups, bodies, 0.0, 0.0, 0.0, 0.0)
    bounded = certificate.with_nearly_unloaded_bodies()
    assert certificate.worst_name == "error of a group"
    assert bounded.groups[1].error == pytest.approx(relative, rel=1e-5)
    assert bounded.bodies[1].error == pytest.approx(relative, rel=1e-5)
    assert bounded.worst == pytest.approx(max(relative, 1e-9), rel=1e-5)


def largest_strained(x: np.ndarray, u: np.ndarray) -> float:
    """Return the largest component of a displacement without its rigid motion."""
    motions = [np.tile(axis, len(x)) for axis in np.eye(3)]
    motions += [np.cross(axis, x).ravel() for axis in np.eye(3)]
    rigid = np.transpose(motions)
    return float(np.abs(u - rigid @ np.linalg.lstsq(rigid, u, rcond=None)[0]).max())


@pytest.mark.parametrize("length", [1.0, 1e-9])
def test_slip_across_the_force_is_relative_to_the_deformation(length):
    """In metres, of rows of any length; whichever nodes hold the subdomains in K^+."""
    solver = TornSolver(in_units(blocks_that_do_not_match(), 1.0, length), Options(rtol=1e-2))
    found = solver.solve()
    torn = recovered_from(solver, found.multipliers)[0].torn
    parts = np.split(torn, solver.setup.local.unknowns.ends[1:-1])
    deformation = max(
        largest_strained(s.coordinates / length, u)
        for s, u in zip(solver.system.subdomains, parts, strict=True)
    )
    force = found.tangential_force / np.linalg.norm(found.tangential_force, axis=1)[:, None]
    along = np.maximum(np.sum(found.slip * force, axis=1), 0.0)
    across = np.linalg.norm(found.slip - along[:, None] * force, axis=1)[~found.sticking].max()
    expected = across / deformation
    assert 1e-3 < expected == pytest.approx(found.report.certificate.slip_across_force, rel=1e-9)


@pytest.mark.parametrize("name", ["penetration", "smallest_force", "error"])
def test_nan_is_no_accuracy(name):
    """It is infinite wherever it is, and in the name of the largest number."""
    fields = dict.fromkeys(
        ("bound", "error", "equilibrium", "penetration", "smallest_force", "complementarity"), 0.0
    )
    group, body = GroupError(["a"], 1.0, 0.0), BodyError("a", 1.0, np.nan, 1.0)
    certificate = Certificate(**{**fields, name: np.nan}, groups=[group], bodies=[])
    assert certificate.worst == np.inf
    assert certificate.numbers()[certificate.worst_name] == np.inf
    assert Certificate(**fields, groups=[group], bodies=[body]).worst == np.inf
    assert Certificate(**fields, groups=[group], bodies=[]).worst == 0.0


def test_bound_with_coulombs_law_is_that_of_the_last_slip_bounds():
    system = pushed_block()
    assert TornSolver(system).solve().report.certificate.guaranteed
    law = {"bound": np.zeros(system.friction.size), "coefficient": np.full(16, 0.3)}
    coulomb = with_fields(system, "friction", **law)
    report = TornSolver(coulomb, Options(rtol=1e-3)).solve().report
    assert not report.certificate.guaranteed
    assert "estimated as" in str(report)
