"""Rigid bodies: subdomains without stiffness, against dense solutions of the KKT conditions."""

import dataclasses

import numpy as np
import pytest
from pairwise import pairwise
from sparse_rows import assert_same_on_ranks, clamped
from torn import Glued, cube, with_prescribed

from fenics_tfeti.errors import InputError, UnresistedMotion
from fenics_tfeti.feti import (
    ContactRows,
    Options,
    Prescribed,
    Subdomain,
    TornSolver,
    TornSystem,
    load_system,
    save_system,
)
from fenics_tfeti.feti.local.rigid_body_modes import raw_modes, rigid_body_modes

pytestmark = pytest.mark.once

RIGID = 10**9
# corners of a tetrahedron: a place is a sum of them with coefficients that add up to 1
FRAME = np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 2.0]])


def of_frame(x):
    """Return the coefficients (k, 4) of places in the corners of the frame."""
    whole = np.vstack([FRAME.T, np.ones(4)])
    return np.linalg.solve(whole, np.column_stack([x, np.ones(len(x))]).T).T


def load(force, moment=(0.0, 0.0, 0.0), at=(1.0, 0.5, 1.0)):
    """Return forces at the corners of the frame with a resultant and a moment about a place."""
    resultants = raw_modes(FRAME, np.asarray(at)).T
    return np.linalg.lstsq(resultants, np.append(force, moment), rcond=None)[0]


def rows_below(block, first=RIGID, gap=0.0, normal=(0.0, 0.0, 1.0), tied=False):
    """Return rows between the nodes of the plane z = 1 and a rigid body, for each of the normals.

    Each node has one row, a tied one a row for each component.
    """
    nodes, place = np.unique(np.concatenate([s.nodes for s in block]), return_index=True)
    x = np.concatenate([s.coordinates for s in block])[place]
    top = np.isclose(x[:, 2], 1.0)
    nodes, x = nodes[top], x[top]
    normals = np.eye(3) if tied else np.array([normal])
    weights = np.column_stack([np.ones(len(x)), -of_frame(x)])
    coefficients = weights[:, None, :, None] * normals[None, :, None, :]
    corners = np.broadcast_to(first + np.arange(4), (len(x), 4))
    terms = np.repeat(np.column_stack([nodes, corners]), len(normals), axis=0)
    k = len(terms)
    gaps = gap(x) if callable(gap) else np.full(k, gap)
    return ContactRows(
        5 * np.arange(k + 1), terms.ravel(), coefficients.reshape(-1, 3), gaps, np.zeros(k, int)
    )


def punch(**changes):
    """Return two glued cubes, clamped below, under a rigid body with an eccentric force."""
    block = [cube(2, (i, 0, 0)) for i in range(2)]
    force = changes.pop("load", load([0.0, 0.0, -0.1], [0.02, 0.03, 0.0]))
    kernel = changes.pop("kernel", None)
    rigid = Subdomain.rigid(force, FRAME, RIGID + np.arange(4), 1, kernel)
    system = TornSystem(
        [*block, rigid],
        clamped(block, (2, 0.0)),
        rows_below(block, gap=lambda x: 0.01 * (x[:, 0] - 1.0) ** 2),
        3,
        ["block", "punch"],
        ["joint"],
    )
    return dataclasses.replace(system, **changes)


def guided():
    """Return the motions along z and about x and y through the middle of the block's top."""
    return raw_modes(FRAME, np.array([1.0, 0.5, 1.0]))[:, 2:5]


def bonded():
    """Return the punch as a plate that is tied to the block, pulled and turned in any direction."""
    system = punch(load=load([0.02, 0.01, 0.1], [0.01, 0.02, 0.03]), contacts=ContactRows.none(3))
    return dataclasses.replace(system, tied=rows_below(system.subdomains[:2], tied=True))


def glued():
    """Return a column of which the middle is rigid: glued to cubes below and above by numbers."""
    below, above = cube(2), cube(2, (0, 0, 2), load=(0.02, 0.01, 0.1))
    nodes = np.append(
        below.nodes[below.coordinates[:, 2] == 1.0], above.nodes[above.coordinates[:, 2] == 2.0]
    )
    x = np.concatenate([below.coordinates, above.coordinates])
    x = x[(x[:, 2] == 1.0) | (x[:, 2] == 2.0)]
    middle = Subdomain.rigid(np.tile([0.0, 0.01, 0.0], len(x)), x, nodes, 0)
    return TornSystem([below, middle, above], clamped([below], (2, 0.0)), ContactRows.none(3), 3)


def with_a_rigid_row():
    """Return the punch on a block with a clamped corner below: this row is at the punch alone."""
    system = punch(kernel=guided())
    block = system.subdomains[0]
    corner = block.nodes[(block.coordinates == [0.0, 0.0, 1.0]).all(axis=1)]
    return with_prescribed(system, corner, [0, 1, 2])


def pushed():
    """Return the punch with its corners moved by given displacements, downwards and tilted."""
    system, corners = punch(), RIGID + np.array([0, 1, 2])
    system = with_prescribed(system, corners, [2], -0.002)
    system.prescribed.values[-2] = -0.007
    return with_prescribed(with_prescribed(system, corners[:2], [1]), corners[:1], [0])


def stacked():
    """Return the punch with a rigid weight on three corners: rows of rigid bodies alone."""
    system = punch(kernel=guided(), load=np.zeros(12))
    weight = load([0.0, 0.0, -0.1], [0.0, 0.03, 0.0], at=[0.7, 0.3, 1.0])
    first = RIGID + np.arange(3)
    upper = Subdomain.rigid(weight, FRAME, RIGID + 4 + np.arange(4), 2, guided())
    on_top = ContactRows.node_to_node(
        first + 4, first, np.tile([0.0, 0.0, -1.0], (3, 1)), np.full(3, 0.001), np.ones(3, int)
    )
    rows = ContactRows.concatenate([system.contacts, on_top])
    return dataclasses.replace(
        system,
        subdomains=[*system.subdomains, upper],
        contacts=rows,
        body_names=["block", "punch", "weight"],
        contact_names=["joint", "top"],
    )


def nearly_parallel(angle):
    """Return the guided punch with another one on the same nodes, whose surface is tilted."""
    system = punch(kernel=guided(), load=load([0.0, 0.0, -0.1], [0.01, -0.02, 0.0]))
    force, first = load([0.0, 0.0, -0.1], [-0.01, 0.02, 0.0]), RIGID + 4
    other = Subdomain.rigid(force, FRAME, first + np.arange(4), 2, guided())
    normal = (np.sin(angle), 0.0, np.cos(angle))
    rows = rows_below(system.subdomains[:2], first, lambda x: 0.01 * (x[:, 1] - 0.5) ** 2, normal)
    rows = dataclasses.replace(rows, contact=np.ones(rows.size, dtype=int))
    return dataclasses.replace(
        system,
        subdomains=[*system.subdomains, other],
        contacts=ContactRows.concatenate([system.contacts, rows]),
        body_names=["block", "punch", "other"],
        contact_names=["joint", "tilted"],
    )


def unknown_closing():
    """Return two blocks that a given force pulls together: their rows share a scalar unknown."""
    below, above = cube(2), cube(2, (0, 0, 1), body=1, first=2 * RIGID)
    axis = np.array([[0.0], [0.0], [1.0]])
    closing = Subdomain.rigid([0.0, 0.0, 0.3], [[0.5, 0.5, 1.0]], [RIGID], 2, axis)
    lower = np.sort(below.nodes[below.coordinates[:, 2] == 1.0])
    upper = lower + 2 * RIGID
    terms = np.column_stack([upper, lower, np.full(lower.size, RIGID)]).repeat(3, axis=0)
    signs = np.array([1.0, -1.0, 1.0])
    every = np.tile(np.eye(3)[:, None, :], (lower.size, 1, 1, 1))
    coefficients, k = (signs[:, None] * every).reshape(-1, 3), len(terms)
    tied = ContactRows(
        3 * np.arange(k + 1), terms.ravel(), coefficients, np.zeros(k), np.zeros(k, int)
    )
    fixed = clamped([below, above], (2, 0.0), (2, 2.0))
    return TornSystem([below, above, closing], fixed, ContactRows.none(3), 3, tied=tied)


SYSTEMS = {
    "guided": lambda: punch(kernel=guided()),
    "bonded": bonded,
    "glued": glued,
    "rigid row": with_a_rigid_row,
    "pushed": pushed,
    "stacked": stacked,
    "closing": unknown_closing,
}


def solve_dense(system, active):
    """Return displacements and contact forces of the KKT system on the active rows."""
    whole = Glued.of(system)
    motions = np.eye(whole.f.size)[:, whole.free]
    rigid = [i for i, s in enumerate(system.subdomains) if s.is_rigid]
    for i in rigid:
        s, at = system.subdomains[i], whole.places[i]
        R = rigid_body_modes(s.coordinates) if isinstance(s.kernel, str) else s.kernel
        motions[at] = 0.0
        motions = np.hstack(
            [motions[:, np.abs(motions).any(axis=0)], np.eye(whole.f.size)[:, at] @ R]
        )
    fixed = np.setdiff1d(np.arange(whole.f.size), whole.free)
    closed = np.vstack([whole.C[active], whole.T, np.eye(whole.f.size)[fixed]])
    right = np.concatenate([system.contacts.gap[active], system.tied.gap, whole.u[fixed]])
    A = closed @ motions
    kkt = np.block([[motions.T @ whole.K @ motions, A.T], [A, np.zeros((len(A), len(A)))]])
    # supports may be redundant
    x = np.linalg.lstsq(kkt, np.append(motions.T @ whole.f, right), rcond=1e-13)[0]
    assert np.abs(kkt @ x - np.append(motions.T @ whole.f, right)).max() < 1e-12
    u, forces = motions @ x[: motions.shape[1]], x[motions.shape[1] :]
    return whole, u, forces[: active.sum()]


@pytest.mark.parametrize(
    ("name", "method", "scaling"),
    pairwise(SYSTEMS, ["active_set", "smalbe"], ["stiffness", "multiplicity"]),
)
def test_against_dense_solution(name, method, scaling):
    system = SYSTEMS[name]()
    options = Options(rtol=1e-11, method=method, scaling=scaling)
    solution = TornSolver(system, options).solve()
    whole, u, forces = solve_dense(system, solution.active)
    places = np.concatenate(whole.places)
    size = np.abs(u).max()
    assert np.abs(np.concatenate(solution.displacements) - u[places]).max() <= 1e-10 * size
    if forces.size:
        assert 0 < forces.size < system.contacts.size
        assert (forces > 0.0).all()
        assert (whole.C @ u <= system.contacts.gap + 1e-10 * size).all()
        assert solution.normal_force[solution.active] == pytest.approx(forces, rel=1e-8)


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize("angle", [2e-6, 1e-5])
def test_surfaces_that_are_nearly_parallel(angle, method):
    """The bodies move by what two rows of a node lack, which moves by little along them."""
    system = nearly_parallel(angle)
    solution = TornSolver(system, Options(rtol=1e-9, method=method)).solve()
    whole, u, forces = solve_dense(system, solution.active)
    size = np.abs(u).max()
    assert (forces > 0.0).all()
    assert (whole.C @ u <= system.contacts.gap + 1e-9 * size).all()
    expected = u[np.concatenate(whole.places)]
    assert np.abs(np.concatenate(solution.displacements) - expected).max() <= 1e-8 * size
    rough = TornSolver(system, Options(rtol=1e-5, method=method)).solve()
    assert np.abs(np.concatenate(rough.displacements) - expected).max() <= 1e-4 * size
    assert rough.report.products["total"] <= 100


@pytest.mark.ranks(2)
@pytest.mark.parametrize("name", ["guided", "glued", "rigid row", "stacked", "closing"])
def test_solution_does_not_depend_on_ranks(name):
    assert_same_on_ranks(SYSTEMS[name](), Options(rtol=1e-11), 1e-10)


def test_certificate_and_resultants():
    """The rigid body moves rigidly up to the last digits, and its contact carries its load."""
    system = punch(kernel=guided())
    solution = TornSolver(system, Options(rtol=1e-4)).solve()
    _, u, _ = solve_dense(system, solution.active)
    of_punch, R = solution.displacements[-1], rigid_body_modes(FRAME)
    assert np.abs(of_punch - R @ (R.T @ of_punch)).max() <= 1e-14 * np.abs(u).max()
    report = solution.report
    assert report.certificate.error <= 1e-4
    assert report.certificate.equilibrium <= 1e-6
    (joint,) = report.contacts
    assert joint.normal_force == pytest.approx(0.1, rel=1e-12)
    assert report.equilibrium <= 1e-12


def test_body_that_nothing_holds():
    with pytest.raises(UnresistedMotion, match=r"punch: translation along \(1, 0, 0\)"):
        TornSolver(punch(load=load([0.1, 0.0, -0.1])))


@pytest.mark.parametrize("name", ["guided", "bonded", "closing"])
def test_file(name, tmp_path):
    system = SYSTEMS[name]()
    save_system(tmp_path / "system.npz", system)
    again = load_system(tmp_path / "system.npz")
    for s, t in zip(system.subdomains, again.subdomains, strict=True):
        assert s.is_rigid == t.is_rigid
        assert s.has_kernel_of(t)
    first, second = (TornSolver(s, Options()).solve() for s in (system, again))
    for u, v in zip(first.displacements, second.displacements, strict=True):
        assert np.array_equal(u, v)


def test_factors_are_reused():
    system = punch(kernel=guided())
    first = TornSolver(system)
    first.solve()
    *block, rigid = system.subdomains
    heavier = dataclasses.replace(rigid, load=2.0 * rigid.load)
    second = TornSolver(dataclasses.replace(system, subdomains=[*block, heavier]), previous=first)
    assert second.reused[0] == "factors"


BAD = {
    "depend on each other": np.hstack([guided(), guided()[:, :1]]),
    "deforms the body": np.eye(12)[:, :1],
    "NaN or infinite": np.full((12, 1), np.nan),
    "shape": np.ones((3, 1)),
}


@pytest.mark.parametrize("words", BAD)
def test_wrong_motions(words):
    with pytest.raises(InputError, match=f"kernel of subdomain 2 .punch.*{words}"):
        TornSolver(punch(kernel=BAD[words]))


def test_motions_of_a_subdomain_with_stiffness():
    system = punch()
    block = dataclasses.replace(system.subdomains[0], kernel=np.ones((81, 1)))
    with pytest.raises(InputError, match="this one has stiffness"):
        TornSolver(dataclasses.replace(system, subdomains=[block, *system.subdomains[1:]]))


def test_bodies_on_a_line_and_at_a_point():
    """What moves no node of them is neither free nor a reason to fail."""
    system = punch(kernel=guided())
    line = Subdomain.rigid(
        np.zeros(6), [[0.0, 0.0, 3.0], [1.0, 0.0, 3.0]], [2 * RIGID, 2 * RIGID + 1], 2
    )
    point = Subdomain.rigid(np.zeros(3), [[0.0, 0.0, 4.0]], [3 * RIGID], 3)
    names = ["block", "punch", "line", "point"]
    solution = TornSolver(
        dataclasses.replace(system, subdomains=[*system.subdomains, line, point], body_names=names)
    ).solve()
    assert not np.concatenate(solution.displacements[-2:]).any()
    assert solution.report.certificate.error <= 1e-6


def test_rigid_bodies_alone():
    lower, upper = (
        Subdomain.rigid([0.0, 0.0, -1.0], [[0.0, 0.0, z]], [int(z)], int(z), np.eye(3))
        for z in (0.0, 1.0)
    )
    rows = ContactRows([0, 2], [1, 0], [[0, 0, 1.0], [0, 0, -1.0]], [0.1], [0])
    with pytest.raises(InputError, match="none has a stiffness, and nothing says how"):
        TornSolver(TornSystem([lower, upper], Prescribed(), rows, 3))
