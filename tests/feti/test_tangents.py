"""Indefinite tangents of compressed bodies: choice, projection, and solutions of the contact."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import fibres
import numpy as np
import pytest
import scipy.sparse as sp
from fibres import FAR
from glued_reference import assert_solves, primal_solution
from prestressed import compression, pressed_block, stressed
from torn import Glued, node_rows

from fenics_tfeti.errors import InputError, UnstableTangent
from fenics_tfeti.feti import (
    ContactRows,
    Friction,
    Options,
    Prescribed,
    Subdomain,
    TornSolution,
    TornSolver,
    TornSystem,
    check_system,
    load_system,
    prepare_tangents,
    save_system,
)
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.local.congruence import find_congruence_classes
from fenics_tfeti.feti.local.rigid_body_modes import kernel, rigid_body_modes
from fenics_tfeti.feti.tangents import projected_tangent
from fenics_tfeti.feti.tolerances import WEAK

pytestmark = pytest.mark.once

# the torn subdomains, 12 elements wide and 2 high, buckle; the block of them does not
SLENDER = {"shape": (12, 2), "columns": 2, "layers": 6, "pressure": 0.1}
BLOCKS: dict[str, dict[str, Any]] = {
    "2D": {"gdim": 2},
    "2D, firmly": {"gdim": 2, "pressure": 0.1},
    "2D, many": {"gdim": 2, "shape": (2, 2), "columns": 8, "layers": 5},
    "2D, slender": SLENDER,
    "3D": {"gdim": 3, "layers": 1},
}
every_block = pytest.mark.parametrize("name", list(BLOCKS))


def eigenvalues(part: Subdomain) -> np.ndarray:
    """Return those of K relative to its mean diagonal."""
    K = part.stiffness.toarray()
    return np.linalg.eigvalsh(K) / K.diagonal().mean()


def negative(system: TornSystem) -> int:
    return sum(int(np.count_nonzero(eigenvalues(s) < -1e-9)) for s in system.subdomains)


@lru_cache(maxsize=None)
def solved(name: str, kind: str = "exact", **options: Any) -> TornSolution:
    system = prepare_tangents(pressed_block(**BLOCKS[name]), kind)
    return TornSolver(system, Options(rtol=1e-8, **options)).solve()


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *((name, {}) for name in BLOCKS),
        ("2D", {"preconditioner": "dirichlet"}),
        ("2D, many", {"preconditioner": "none"}),
        ("3D", {"method": "smalbe"}),
        ("2D, slender", {"scaling": "multiplicity"}),
        ("3D", {"dual_operator": "explicit"}),
    ],
    ids=lambda value: " ".join(value.values()) or "default" if isinstance(value, dict) else value,
)
def test_solution_against_the_primal_one(name, options):
    system = pressed_block(**BLOCKS[name])
    found = solved(name, **options)
    assert_solves(found, system)
    assert found.report.deflation["negative"] == negative(system) > 0
    assert found.report.deflation["vectors"] >= found.report.deflation["negative"]
    # slender subdomains buckle: other negative eigenvalues than those of rotations
    assert name != "2D, slender" or negative(system) >= 2 * len(system.subdomains)


@every_block
def test_products_are_those_of_the_unstressed_block(name):
    block = pressed_block(**{**BLOCKS[name], "pressure": 0.0})
    linear = TornSolver(block, Options(rtol=1e-8)).solve().report
    assert solved(name).report.products["total"] <= linear.products["total"] + 4


@pytest.mark.parametrize("gdim", [2, 3])
def test_tension_is_not_negative(gdim):
    system = pressed_block(gdim, -0.05, layers=1)
    found = TornSolver(prepare_tangents(system, "exact"), Options(rtol=1e-8)).solve()
    assert_solves(found, system)
    assert found.report.deflation["negative"] == 0
    assert found.report.certificate.guaranteed


def test_report_says_that_the_error_is_an_estimate():
    exact, projected = solved("2D").report, solved("2D", "projected").report
    assert not exact.certificate.guaranteed and projected.certificate.guaranteed
    assert "7 directions, 7 of them negative" in str(exact)
    assert "estimated as" in str(exact) and "at most" in str(projected)
    assert exact.equilibrium <= 1e-8


def test_estimate_is_of_the_size_of_the_error():
    system = pressed_block(**BLOCKS["2D"])
    found = TornSolver(prepare_tangents(system, "exact"), Options(rtol=1e-2)).solve()
    expected, places = primal_solution(system)
    K = Glued.of(system).K
    difference = np.zeros_like(expected.displacement)
    for u, at in zip(found.displacements, places, strict=True):
        difference[at] = u - expected.displacement[at]
    error = np.sqrt(difference @ (K @ difference))
    assert 0.1 * error <= found.report.certificate.bound <= 20.0 * error


# -- what is unstable ------------------------------------------------------------------------------


def test_unstable_tangent_is_refused_and_its_projection_is_not():
    system = pressed_block(2, 0.1, shape=(2, 12), columns=6, layers=1)
    with pytest.raises(UnstableTangent, match=r"have 24 negative .* remove 23: .*'projected'"):
        TornSolver(prepare_tangents(system, "exact"))
    projected = prepare_tangents(system, "projected")
    found = TornSolver(projected, Options(rtol=1e-8)).solve()
    assert_solves(found, projected)
    assert found.report.deflation["negative"] == 0


@pytest.mark.parametrize("preconditioner", ["lumped", "dirichlet"])
def test_subdomain_that_buckles_with_its_interface_held_is_unstable(preconditioner):
    """The Dirichlet preconditioner factors its interior."""
    system = prepare_tangents(pressed_block(2, 0.7), "exact")
    with pytest.raises(UnstableTangent, match="or a smaller load step"):
        TornSolver(system, Options(preconditioner=preconditioner, factor="mumps"))


def test_body_that_only_contact_holds_is_projected():
    system = pressed_block(clamped=False)
    with pytest.raises(UnstableTangent, match="or where only contact holds a body"):
        TornSolver(prepare_tangents(system, "exact"))
    prepared = prepare_tangents(system)
    kernels = {(s.body, s.kernel) for s in prepared.subdomains}
    assert kernels == {(0, "translations"), (1, "rigid")}
    assert_solves(TornSolver(prepared, Options(rtol=1e-8)).solve(), prepared)


@pytest.mark.parametrize(("kind", "free"), [("exact", 2), ("projected", 3)])
def test_rotations_of_exact_tangents_are_no_free_motions(kind, free):
    setup = TornSolver(prepare_tangents(pressed_block(), kind)).setup
    nothing = Face.of_rows(setup.constraints, np.zeros(setup.constraints.size, dtype=bool))
    resistance = setup.projector.coarse_space._resistance(nothing, WEAK)
    bodies = 2
    assert resistance.free.shape[1] == free * bodies and not resistance.resisted.shape[1]


def test_deflation_is_needed():
    with pytest.raises(InputError, match="'off', but .* have 7 negative eigenvalues"):
        TornSolver(prepare_tangents(pressed_block()), Options(deflation="off"))


# -- choice and projection -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tied", "kernel"), [(7, "translations"), (2, "translations"), (1, "rigid")]
)
def test_body_is_held_by_what_it_is_tied_to(tied, kernel):
    """Two tied nodes hold the punch in the plane, one leaves it its rotation."""
    system = pressed_block(clamped=False)
    base = system.prescribed.nodes < FAR**2
    given = system.prescribed
    prescribed = Prescribed(given.nodes[base], given.components[base], given.values[base])
    ends = system.contacts.nodes.reshape(-1, 2)[:tied]
    rows = [node_rows(ends[:, 0], normal, ends[:, 1]) for normal in np.identity(2)]
    system = replace(system, prescribed=prescribed, tied=ContactRows.concatenate(rows))
    prepared = prepare_tangents(replace(system, contacts=ContactRows.none(2)))
    assert {s.kernel for s in prepared.subdomains if s.body == 1} == {kernel}
    assert {s.kernel for s in prepared.subdomains if s.body == 0} == {"translations"}


def test_symmetric_part_of_a_tangent_is_taken():
    system = pressed_block(2, pressure=0.1)
    upper = [sp.triu(s.stiffness, 1) for s in system.subdomains]
    parts = zip(system.subdomains, upper, strict=True)
    skewed = [replace(s, stiffness=(s.stiffness + (part - part.T)).tocsr()) for s, part in parts]
    prepared = prepare_tangents(replace(system, subdomains=skewed))
    for new, old in zip(prepared.subdomains, prepare_tangents(system).subdomains, strict=True):
        size = np.abs(old.stiffness.data).max()
        assert abs(new.stiffness - old.stiffness).max() <= 1e-13 * size


@pytest.mark.parametrize(("pressure", "kinds", "kernel"), [
    (0.05, ["auto"], "translations"),
    (0.0, ["auto", "exact", "projected"], "rigid"),
])  # fmt: skip
def test_tangents_of_bodies_that_are_held_are_left_as_they_are(pressure, kinds, kernel):
    system = pressed_block(pressure=pressure)
    for kind in kinds:
        for old, new in zip(
            system.subdomains, prepare_tangents(system, kind).subdomains, strict=True
        ):
            assert new.kernel == kernel and new.stiffness is old.stiffness


@pytest.mark.parametrize("pressure", [1e-5, 3.0], ids=["small stress", "node without stiffness"])
def test_tangents_that_are_projected_all_the_same(pressure):
    system = pressed_block(2, pressure)
    assert (system.subdomains[0].stiffness.diagonal().min() < 0.0) == (pressure == 3.0)
    for part in prepare_tangents(system, "exact").subdomains:
        assert part.kernel == "rigid" and part.stiffness.diagonal().min() > 0.0
        assert pressure == 3.0 or np.sum(np.abs(eigenvalues(part)) < 1e-12) == 3


def test_stress_is_compared_with_shear(monkeypatch):
    """The diagonal of K of a nearly incompressible material is hundreds of times its shear's."""
    monkeypatch.setattr(fibres, "POISSON", 0.499)
    system = prepare_tangents(pressed_block(pressure=0.05))
    assert {part.kernel for part in system.subdomains} == {"translations"}
    found = TornSolver(system, Options(rtol=1e-8)).solve()
    assert_solves(found, system)
    assert found.report.preconditioner == "dirichlet"


def test_free_rotation_stays_in_the_kernel():
    """A uniaxial stress does not act on rotations about its axis."""
    part = prepare_tangents(pressed_block(3, 0.05), "exact").subdomains[0]
    R = kernel(part)
    assert part.kernel == "translations" and R.shape[1] == 4
    assert np.abs(part.stiffness @ R).max() <= 1e-13


@pytest.mark.parametrize("pressure", [1e-3, 0.1, 0.3])
@pytest.mark.parametrize("shape", [(2, 3, 4), (12, 2), (1, 1)])
def test_projected_tangent_is_positive_with_all_rigid_motions(shape, pressure):
    part = pressed_block(len(shape), pressure, shape=shape).subdomains[0]
    K, x = part.stiffness, part.coordinates
    projected, R = projected_tangent(K, x), rigid_body_modes(x)
    values = eigenvalues(replace(part, stiffness=projected))
    assert np.abs(projected @ R).max() <= 1e-13
    assert np.abs(values[: R.shape[1]]).max() <= 1e-13 < values[R.shape[1]]
    assert abs(projected - projected.T).max() <= 1e-14


def test_projected_tangent_differs_little():
    """Where nothing buckles, it is the tangent but for rotations."""
    part = pressed_block(2, 0.02).subdomains[0]
    R = rigid_body_modes(part.coordinates)
    P = np.identity(len(R)) - R @ R.T
    projected = projected_tangent(part.stiffness, part.coordinates)
    exact = P @ part.stiffness @ P
    values = np.linalg.eigvals(np.linalg.pinv(exact, rcond=1e-10) @ projected).real
    assert np.sort(values)[R.shape[1]] > 0.5 and values.max() < 2.0
    assert projected.nnz <= 3 * part.stiffness.nnz


def test_subdomain_on_springs_has_its_exact_tangent():
    """The base of the block stands on springs, which hold it instead of the clamp."""
    system = pressed_block()
    parts, given = [], system.prescribed
    for part in system.subdomains:
        foot = np.repeat(part.coordinates[:, -1] == 0.0, 2)
        springs = sp.diags(np.where(foot, 0.02, 0.0), format="csr")
        parts.append(replace(part, stiffness=part.stiffness + springs) if foot.any() else part)
    top = np.flatnonzero(np.isin(given.nodes, given.nodes[given.values != 0.0]))
    prescribed = Prescribed(given.nodes[top], given.components[top], given.values[top])
    system = replace(system, subdomains=parts, prescribed=prescribed)
    prepared = prepare_tangents(system)
    on_springs = [part for part in prepared.subdomains if part.coordinates[:, -1].min() == 0.0]
    assert {part.kernel for part in on_springs} == {"translations"}
    assert_solves(TornSolver(prepared, Options(rtol=1e-8)).solve(), prepared)


@pytest.mark.parametrize("component", [0, 1])
def test_projected_tangent_on_springs_is_positive(component):
    """Soft springs along one axis do not hold against compression; the other axis stays free."""
    system = pressed_block(2, 0.1, shape=(4, 3), columns=1, layers=1)
    parts = []
    for part in system.subdomains:
        springs = sp.diags(np.tile(np.arange(2) == component, part.nodes.size) * 1e-4)
        parts.append(replace(part, stiffness=(part.stiffness + springs).tocsr()))
    system = replace(system, subdomains=parts)
    for exact, part in zip(
        system.subdomains, prepare_tangents(system, "projected").subdomains, strict=True
    ):
        assert eigenvalues(exact)[0] < -1e-3
        assert np.abs(part.stiffness[:, 1 - component :: 2].sum(axis=1)).max() <= 1e-13
        values = eigenvalues(part)
        assert np.abs(values[0]) <= 1e-13 < values[1]


# -- the rest of the package -----------------------------------------------------------------------


def with_friction(system: TornSystem) -> TornSystem:
    k = system.contacts.size
    tangents = np.tile([[[1.0, 0.0]]], (k, 1, 1))
    friction = Friction(np.arange(k), tangents, np.zeros(k), coefficient=np.full(k, 0.2))
    return replace(system, friction=friction)


def with_whole_bodies(system: TornSystem) -> TornSystem:
    """Return the system with one subdomain for each body."""
    wholes = []
    for body in sorted({s.body for s in system.subdomains}):
        parts = [s for s in system.subdomains if s.body == body]
        nodes, first = np.unique(np.concatenate([s.nodes for s in parts]), return_index=True)
        x = np.concatenate([s.coordinates for s in parts])[first]
        K, f = sp.csr_matrix((x.size, x.size)), np.zeros(x.size)
        for s in parts:
            at = (
                system.gdim * np.searchsorted(nodes, s.nodes)[:, None] + np.arange(system.gdim)
            ).ravel()
            T = sp.csr_matrix((np.ones(at.size), (at, np.arange(at.size))), (x.size, at.size))
            K, f = (K + T @ s.stiffness @ T.T).tocsr(), f + T @ s.load
        wholes.append(Subdomain(K, f, x, nodes, body))
    return replace(system, subdomains=wholes)


def test_friction_does_not_depend_on_the_partition():
    block = with_friction(pressed_block(2, 0.05, shape=(4, 4), columns=4))
    found = [
        TornSolver(prepare_tangents(system, "exact"), Options(rtol=1e-8)).solve()
        for system in (block, with_whole_bodies(block))
    ]
    one, other = found
    assert 0 < one.sticking.sum() < one.sticking.size
    largest = one.normal_force.max()
    np.testing.assert_allclose(one.normal_force, other.normal_force, rtol=0.0, atol=1e-6 * largest)
    np.testing.assert_allclose(
        one.tangential_force, other.tangential_force, rtol=0.0, atol=1e-6 * largest
    )


def test_load_step_reuses_factors_and_directions():
    first = TornSolver(prepare_tangents(pressed_block()))
    first.solve()
    loaded = [replace(s, load=s.load + 1e-3) for s in first.system.subdomains]
    system = replace(first.system, subdomains=loaded)
    second = TornSolver(system, Options(rtol=1e-8), previous=first)
    assert second.setup.deflation is first.setup.deflation
    assert_solves(second.solve(), system)


def test_kernels_are_saved(tmp_path):
    system = prepare_tangents(pressed_block(clamped=False))
    save_system(tmp_path / "system.npz", system)
    loaded = load_system(tmp_path / "system.npz")
    assert [s.kernel for s in loaded.subdomains] == [s.kernel for s in system.subdomains]


def test_unknown_kernel_is_refused():
    system = pressed_block()
    wrong = replace(system.subdomains[1], kernel="rotations")
    with pytest.raises(InputError, match="kernel of .*: got 'rotations', expected 'rigid' or"):
        check_system(replace(system, subdomains=[system.subdomains[0], wrong]))


def test_matrices_of_other_kernels_are_not_congruent():
    part = stressed(pressed_block(pressure=0.0).subdomains[0], compression(2, 0.05))
    other = replace(part, kernel="translations")
    assert len(find_congruence_classes([part, other, part])) == 2
