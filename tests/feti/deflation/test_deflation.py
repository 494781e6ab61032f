"""F_c and d_c against dense algebra, and solutions with and without deflation."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from dense import DenseSystem
from fibres import reinforced_block
from glued_reference import assert_solves
from pairwise import pairwise
from torn import column

from fenics_tfeti.feti import Options, TornSolution, TornSolver, TornSystem
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.deflation.local_spectra import LocalVectors
from fenics_tfeti.feti.deflation.space import Deflation, _coefficients, _responses, at_most
from fenics_tfeti.feti.local.congruence import CongruenceClass

pytestmark = pytest.mark.once

RATIOS = [1e4, 1e6]
METHODS = ["active_set", "smalbe"]
every_gdim = pytest.mark.parametrize("gdim", [2, 3])


def block(gdim: int, ratio: float) -> TornSystem:
    return reinforced_block(gdim, ratio, columns=4 if gdim == 2 else 2, layers=4 - gdim)


@lru_cache(maxsize=None)
def solver(gdim: int, **options: Any) -> tuple[TornSolver, Deflation]:
    torn = TornSolver(block(gdim, 1e4), Options(**options))
    assert torn.setup.deflation is not None
    return torn, torn.setup.deflation


@lru_cache(maxsize=None)
def directions(gdim: int) -> np.ndarray:
    """Return U, the columns that are kept."""
    _, found = solver(gdim)
    return np.stack([found.prolonged(alpha) for alpha in found.basis.T], axis=1)


def columns_of(operator: Any, size: int) -> np.ndarray:
    return np.stack([operator(unit) for unit in np.eye(size)], axis=1)


@every_gdim
def test_deflated_operator_is_the_schur_complement(gdim):
    torn, _ = solver(gdim)
    system, U, constraints = DenseSystem.of(torn), directions(gdim), torn.setup.constraints
    # U satisfies the constraints
    assert not U[constraints.inequality].any()
    largest = np.abs(system.G).max() * np.abs(U).max()
    np.testing.assert_allclose(system.G @ U, 0.0, atol=1e-12 * largest)
    P, F = system.projector(), system.F
    # U'F depends on the generalized inverse by rigid motions only, which P removes
    FU = F @ U
    exact = P @ (F - FU @ np.linalg.solve(U.T @ FU, FU.T)) @ P
    found = P @ columns_of(torn.setup.part, len(P)) @ P
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=1e-10 * np.abs(F).max())
    largest = np.linalg.eigvalsh(0.5 * (found + found.T))[-1]
    assert 0.9 * largest <= torn.setup.norm(30) <= 1.3 * largest
    assert largest <= 0.1 * np.linalg.eigvalsh(P @ F @ P)[-1]


@every_gdim
def test_deflated_operator_and_load_vanish_on_the_directions(gdim):
    torn, _ = solver(gdim)
    U = directions(gdim)
    before, after = (np.stack([f(u) for u in U.T]) for f in (torn.setup.F.part, torn.setup.part))
    assert np.abs(after).max() <= 1e-10 * np.abs(before).max()
    d = np.random.default_rng(0).standard_normal(len(U))
    # as F is larger on U than elsewhere, so is what rounding leaves
    assert np.abs(U.T @ torn.setup.reduced(d)).max() <= 1e-8 * np.abs(U.T @ d).max()


@every_gdim
def test_completed_multipliers_have_no_residual_on_the_directions(gdim):
    torn, found = solver(gdim)
    U = directions(gdim)
    d = torn.setup.F.load(torn.data.load, torn.data.c)
    rng = np.random.default_rng(0)
    given, at = rng.standard_normal((2, d.size))
    full = found.completed(given, d - torn.setup.F(at), at)
    size = np.abs(U.T @ (d - torn.setup.F(given))).max()
    assert np.abs(U.T @ (d - torn.setup.F(full))).max() <= 1e-9 * size
    # and they differ by the directions only
    rest = full - given - U @ np.linalg.lstsq(U, full - given, rcond=None)[0]
    assert np.abs(rest).max() <= 1e-9 * np.abs(full - given).max()


@lru_cache(maxsize=None)
def solved(gdim: int, ratio: float, **options: Any) -> TornSolution:
    accurate = {"rtol": 1e-8, "smalbe_patience": 500, **options}
    return TornSolver(block(gdim, ratio), Options(**accurate)).solve()


@pytest.mark.parametrize(
    ("gdim", "ratio", "preconditioner", "method"),
    pairwise([2, 3], RATIOS, ["lumped", "dirichlet", "none"], METHODS),
)
def test_solution_against_the_primal_one(gdim, ratio, preconditioner, method):
    found = solved(gdim, ratio, preconditioner=preconditioner, method=method)
    assert found.report.deflation["vectors"] > 0
    assert_solves(found, block(gdim, ratio), energy=1e-9)


@pytest.mark.parametrize(
    ("gdim", "ratio", "preconditioner", "method"),
    pairwise([2, 3], RATIOS, ["lumped", "dirichlet"], METHODS),
)
def test_products_do_not_depend_on_the_material(gdim, ratio, preconditioner, method):
    options = {"rtol": 1e-6, "preconditioner": preconditioner, "method": method}
    jumping, uniform = (solved(gdim, r, **options).report for r in (ratio, 1.0))
    plain = solved(gdim, ratio, **options, deflation="off").report
    assert jumping.products["total"] <= 1.5 * uniform.products["total"]
    assert plain.products["total"] > 1.5 * jumping.products["total"]


@pytest.mark.parametrize("gdim", [2, 3])
@pytest.mark.parametrize(("ratio", "kind"), [(1.0, "auto"), (1.0, "on"), (1e4, "off")])
def test_uniform_material_gives_no_vectors_and_off_means_off(gdim, ratio, kind):
    report = solved(gdim, ratio, deflation=kind).report
    assert report.deflation == {"vectors": 0, "bytes": 0, "negative": 0}
    assert (report.products["deflation"] > 0) == (kind == "on")


def test_without_weights_of_stiffness_only_if_it_is_asked_for():
    """With weights of 1, eigenvalues of soft subdomains are large for no reason of the cut."""
    for kind, found in (("auto", False), ("on", True)):
        torn = TornSolver(block(2, 1e4), Options(scaling="multiplicity", deflation=kind))
        assert (torn.setup.deflation is not None) == found


def test_report_counts_vectors_memory_and_solves():
    torn, found = solver(2)
    report = torn.solve().report
    assert report.deflation["vectors"] == found.size
    assert report.deflation["bytes"] == found.bytes
    responses = sum(response.displacements.nbytes for response in found.responses)
    assert responses < found.bytes < 3 * responses
    solves = sum(len(r.displacements) for r in found.responses) + found.vectors.solves
    assert report.products["deflation"] == -(-solves // len(torn.system.subdomains))


def test_dual_problem_for_other_methods_is_not_deflated():
    torn, _ = solver(2)
    problem = torn.dual_problem()
    x = np.random.default_rng(0).standard_normal(torn.setup.constraints.size)
    np.testing.assert_array_equal(problem.F(x), torn.setup.F.part(x))
    np.testing.assert_array_equal(problem.d, torn.setup.F.load(torn.data.load, torn.data.c))


# -- reuse ---------------------------------------------------------------------------------------


def test_load_step_reuses_all():
    torn, found = solver(2)
    torn.solve()
    heavier = [replace(s, load=2.0 * s.load) for s in torn.system.subdomains]
    second = TornSolver(replace(torn.system, subdomains=heavier), torn.options, previous=torn)
    assert second.setup.deflation is found
    report = second.solve().report
    assert report.products["deflation"] == 0


def test_other_contact_rows_reuse_the_vectors():
    """Rows with other coefficients, as of exact non-penetration: F changes, U does not."""
    torn, found = solver(2)
    contacts = torn.system.contacts
    tilted = contacts.coefficients @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    system = replace(torn.system, contacts=replace(contacts, coefficients=tilted))
    second, alone = (TornSolver(system, torn.options, previous=p) for p in (torn, None))
    again = second.setup.deflation
    assert again is not found and again.vectors is found.vectors
    one, other = second.solve().report, alone.solve().report
    assert one.energy == pytest.approx(other.energy, rel=1e-9)
    assert 0 < one.products["deflation"] < other.products["deflation"]


def test_other_equality_rows_need_other_vectors():
    torn, found = solver(2)
    torn.solve()
    p = torn.system.prescribed
    free = p.nodes != p.nodes.min()
    system = replace(
        torn.system, prescribed=replace(p, **{k: getattr(p, k)[free] for k in vars(p)})
    )
    second, alone = (TornSolver(system, torn.options, previous=p) for p in (torn, None))
    assert second.setup.deflation.vectors is not found.vectors
    assert second.setup.deflation.size == alone.setup.deflation.size


# -- difficult cases -----------------------------------------------------------------------------


def test_two_subdomains_may_have_the_same_direction():
    """Columns of U that repeat are left out: U'FU is definite."""
    torn, found = solver(2)
    twice = LocalVectors(
        2 * found.vectors.rows,
        2 * found.vectors.values,
        np.tile(found.vectors.excess, 2),
        found.vectors.solves,
    )
    again = Deflation.build(torn.setup.projector.coarse_space, torn.setup.F.on_interface, twice)
    assert again.size == found.size
    x = np.random.default_rng(0).standard_normal(torn.setup.constraints.size)
    expected = torn.setup.projector.P(torn.setup.part(x))
    computed = torn.setup.projector.P(again.part(torn.setup.F.packed, x))
    size = np.abs(torn.setup.F.part(x)).max()
    np.testing.assert_allclose(computed, expected, rtol=0.0, atol=1e-9 * size)


def test_directions_that_rigid_motions_determine_are_none():
    """P_E leaves nothing of columns of G_E', as in a chain of slender subdomains."""
    torn, _ = solver(2)
    coarse_space, constraints = torn.setup.projector.coarse_space, torn.setup.constraints
    motions = coarse_space.motions_of_rows(constraints.equality).toarray()
    motions /= np.linalg.norm(motions, axis=0)
    rows = constraints.layout.numbers
    vectors = LocalVectors(
        [rows] * motions.shape[1], list(motions.T), np.ones(motions.shape[1]), solves=0
    )
    assert Deflation.build(coarse_space, torn.setup.F.on_interface, vectors) is None


def deflated_by(system: TornSystem, vectors: LocalVectors, **options: Any) -> TornSolver:
    """Return a solver with the deflation of given vectors."""
    torn = TornSolver(system, Options(deflation="off", **options))
    plain = torn.setup
    given = Deflation.build(plain.projector.coarse_space, plain.F.on_interface, vectors)
    torn.setup = plain.deflated(system, Options(deflation="on"), replace(plain, deflation=given))
    return torn


def test_too_many_vectors_are_an_announced_choice():
    """The fifth and the sixth are equal, by symmetry."""
    torn, found = solver(2)
    with pytest.warns(UserWarning, match=f"{found.vectors.excess.size} .* 4 .*subdomain_size"):
        some = at_most(torn.system.comm, found.vectors, 4)
    assert sorted(some.excess) == sorted(found.vectors.excess)[-4:]
    report = deflated_by(torn.system, some).solve().report
    assert report.converged and report.deflation["vectors"] == 4


def test_a_loose_body_with_fibres():
    """G_E G_E' is singular where only contact holds a body: its motion is no direction."""
    system = block(2, 1e4)
    stiff = [
        replace(s, stiffness=t.stiffness)
        for s, t in zip(system.subdomains[-2:], system.subdomains[:2], strict=True)
    ]
    system = replace(system, subdomains=[*system.subdomains[:-2], *stiff])
    torn, plain = (TornSolver(system, Options(rtol=1e-8, deflation=k)) for k in ("auto", "off"))
    coarse_space = torn.setup.projector.coarse_space
    # the punch may move up and down, and turn
    assert Projector.build(coarse_space, Face.supports(torn.setup.constraints)).free.shape[1] == 2
    assert torn.setup.deflation.size > solver(2)[1].size
    found, expected = torn.solve(), plain.solve()
    assert found.report.energy == pytest.approx(expected.report.energy, rel=1e-8)
    np.testing.assert_allclose(found.normal_force, expected.normal_force, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_any_directions_may_be_deflated(method):
    """Random ones of the gluing and Dirichlet rows, of a small uniform problem."""
    system, options = column(), {"rtol": 1e-8, "method": method}
    plain = TornSolver(system, Options(deflation="off", **options))
    constraints = plain.setup.constraints
    rows = constraints.layout.numbers[constraints.equality]
    values = np.random.default_rng(0).standard_normal((20, rows.size))
    values /= np.linalg.norm(values, axis=1)[:, None]
    vectors = LocalVectors(20 * [rows], list(values), np.ones(20), solves=0)
    found, expected = deflated_by(system, vectors, **options).solve(), plain.solve()
    assert found.report.deflation["vectors"] == 20
    assert found.report.energy == pytest.approx(expected.report.energy, rel=1e-9)
    np.testing.assert_allclose(found.normal_force, expected.normal_force, rtol=0.0, atol=1e-6)


def test_parts_that_cancel_leave_an_accurate_energy():
    """g = 1e6 (f + 1e-6 g) - 1e6 f, where f is soft: 1e8 |f|^2 and |g|^2 are the energies."""
    f, g = np.linalg.qr(np.random.default_rng(0).standard_normal((7, 2)))[0].T
    parts = sp.csr_matrix(np.stack([f + 1e-6 * g, f], axis=1))
    combination = np.array([[1e6, 1.0], [-1e6, 0.0]])
    one = CongruenceClass(np.zeros(1, dtype=int), np.zeros(1, dtype=int), 7)
    space = SimpleNamespace(interface=SimpleNamespace(classes=[one], ends=np.array([0, 7])))
    _, gram = _responses(space, [lambda x: x + 1e8 * np.outer(x @ f, f)], parts, combination)
    assert gram[0, 0] == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize("passes", [1, 2, 3])
def test_coefficients_take_all_passes_of_the_projector(passes):
    """With nine tenths of (GG')^+ each pass leaves a tenth of G U."""
    _, found = solver(2)
    coarse_space = found.coarse_space
    projector = Projector.build(coarse_space, Face.supports(coarse_space.constraints))
    factor = SimpleNamespace(solve=lambda x: 0.9 * projector.gram.factor.solve(x))
    inaccurate = replace(projector, gram=replace(projector.gram, factor=factor), passes=passes)
    G = coarse_space.motions_of_rows(projector.face.rows)
    X = _coefficients(inaccurate, G, found.own)[0]
    size = np.abs(found.X).max()
    np.testing.assert_allclose(X, (1.0 - 0.1**passes) * found.X, atol=1e-12 * size)
