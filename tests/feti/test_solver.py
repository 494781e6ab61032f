"""The feti layer alone, without dolfinx, against dense algebra."""

import dataclasses
import json
import weakref

import numpy as np
import pytest
from torn import Glued, column, cube, node_rows

from fenics_tfeti import InputError, NotConverged, UnresistedMotion
from fenics_tfeti.feti import ContactRows, Options, TornSolver, parse_options


def glued_solution(system):
    """Solve the glued, linear problem by dense algebra; return the torn displacements."""
    whole = Glued.of(system)
    free = whole.free
    whole.u[free] = np.linalg.solve(whole.K[np.ix_(free, free)], whole.f[free])
    return whole.torn()


@pytest.mark.parametrize("expansion", ["standard", "projected_cg"])
@pytest.mark.parametrize("preconditioner", ["none", "lumped", "dirichlet"])
def test_linear_problem(expansion, preconditioner):
    system = column(contact=False)
    options = Options(rtol=1e-9, mprgp_expansion=expansion, preconditioner=preconditioner)
    u = np.concatenate(TornSolver(system, options).solve().displacements)
    exact = np.concatenate(glued_solution(system))
    np.testing.assert_allclose(u, exact, atol=1e-7 * np.abs(exact).max())


@pytest.mark.parametrize("preconditioner", ["none", "lumped", "dirichlet"])
def test_contact_force_balances_the_load(preconditioner):
    options = Options(rtol=1e-9, preconditioner=preconditioner)
    report = TornSolver(column(load=(0, 0, -3.0)), options).solve().report
    assert report.contacts[0].normal_force == pytest.approx(3.0, rel=1e-7)
    assert report.certificate.worst <= 1e-9


def test_products_are_all_applications_of_F(monkeypatch):
    solver = TornSolver(column())
    count = 0
    apply = type(solver.setup.F).packed

    def counting(self, x):
        nonlocal count
        count += 1
        return apply(self, x)

    monkeypatch.setattr(type(solver.setup.F), "packed", counting)
    products = solver.solve().report.products
    assert count == products["total"] + products["norm"]


@pytest.mark.parametrize(("load", "rows", "axis"), [
    (1.0, column().contacts, "0, 0, 1"),
    (-1.0, ContactRows.none(3), "0, 0, -1"),
])  # fmt: skip
def test_body_that_nothing_holds_is_named(load, rows, axis):
    system = dataclasses.replace(column(load=(0, 0, load)), contacts=rows)
    with pytest.raises(UnresistedMotion, match=rf"upper: translation along \({axis}\)"):
        TornSolver(system)


def test_motion_without_load_is_reported_and_left_small():
    """A cube on a frictionless plane may slide and spin about the vertical."""
    block = cube(2, load=(0, 0, -1.0))
    bottom = block.nodes[block.coordinates[:, 2] == 0]
    rows = node_rows(bottom, [0.0, 0.0, -1.0])
    system = dataclasses.replace(column(), subdomains=[block], contacts=rows)
    system = dataclasses.replace(system, prescribed=type(system.prescribed)())
    report = TornSolver(system, Options(rtol=1e-8)).solve().report
    assert len(report.free_motions) == 3
    np.testing.assert_allclose([c.normal_force for c in report.contacts], 1.0, rtol=1e-7)


@pytest.mark.parametrize(
    ("listed", "name", "few"),
    [("free_motions", "free motion", 6), ("weak_motions", "weak motion", 6)],
)
def test_of_many_motions_the_text_has_few_and_the_number_of_others(listed, name, few):
    report = TornSolver(column()).solve().report
    many = dataclasses.replace(report, **{listed: [f"body {k}: slides" for k in range(20)]})
    lines = [line for line in str(many).splitlines() if f"{name}  " in line]
    assert lines[few - 1 :] == [f"{name:>16}  body 5: slides", f"{name:>16}  and 14 other {name}s"]


def test_of_many_contacts_the_text_has_few_and_the_number_of_others():
    report = TornSolver(column()).solve().report
    many = dataclasses.replace(report, contacts=20 * report.contacts)
    lines = [line for line in str(many).splitlines() if "force on slave" in line]
    assert len(lines) == 13
    assert lines[-1] == "  force on slave  and 8 other contacts"


def test_limit():
    with pytest.raises(NotConverged, match="max_products") as caught:
        TornSolver(column(), Options(max_products=2)).solve()
    report = caught.value.report
    assert not report.converged
    assert "the active set method has spent 2 of 2 products" in report.reason
    worst = max(report.certificate.bodies, key=lambda body: body.error).body
    assert f"largest in {worst}" in report.reason


def test_unknown_option():
    with pytest.raises(InputError, match="'rtol'"):
        parse_options({"rtoll": 1e-4})


def test_numbers_that_json_does_not_have_are_null(tmp_path):
    """Not the words Infinity and NaN, which other readers of JSON refuse."""
    report = TornSolver(column()).solve().report
    certificate = dataclasses.replace(report.certificate, penetration=np.inf)
    wrong = dataclasses.replace(
        report,
        energy=np.nan,
        contacts=[dataclasses.replace(report.contacts[0], normal_force=-np.inf)],
        certificate=certificate,
        options={**report.options, "rtol": np.float64(np.nan)},
    )
    wrong.to_json(tmp_path / "report.json")

    def refuse(word):
        raise AssertionError(word)

    read = json.loads((tmp_path / "report.json").read_text(), parse_constant=refuse)
    assert read["energy"] is None
    assert read["contacts"][0]["normal_force"] is None
    assert read["certificate"]["penetration"] is None
    assert read["options"]["rtol"] is None
    assert read["reason"] == report.reason
    assert np.isnan(wrong.to_dict()["energy"])


def test_released_solver_passes_on_its_multipliers():
    """Factors and matrices are gone; the next solver starts where the last one ended."""
    system = column(n=3, load=(0, 0, -1.0))
    stiffer = [dataclasses.replace(s, stiffness=2.0 * s.stiffness) for s in system.subdomains]
    after = dataclasses.replace(system, subdomains=stiffer)
    first = TornSolver(system, Options(rtol=1e-8))
    first.solve()
    kept = TornSolver(after, Options(rtol=1e-8), previous=first)
    factors = [weakref.ref(inverse) for inverse in first.setup.F.inverses]
    first.release()
    assert [factor() for factor in factors] == [None] * len(factors)
    with pytest.raises(InputError, match="released"):
        first.solve()
    second = TornSolver(after, Options(rtol=1e-8), previous=first)
    assert second.reused == kept.reused == ["multipliers"]
    np.testing.assert_array_equal(second.solve().normal_force, kept.solve().normal_force)
    first.release()


def test_further_solves_of_a_solver_spend_nothing_on_the_set_up():
    """Norm and deflation are counted once, and the last multipliers are told."""
    system = column()
    solver = TornSolver(system, Options(method="smalbe"))
    first, second = (solver.solve().report for _ in range(2))
    assert first.products["norm"] > 0
    assert second.products["norm"] == second.products["deflation"] == 0
    assert (first.reused, second.reused[-1]) == ([], "multipliers")


def test_seconds_of_a_report_are_those_of_its_solve():
    solver = TornSolver(column())
    first, second = (solver.solve().report.seconds for _ in range(2))
    assert "factorisation" in first and "factorisation" not in second
    for seconds in (first, second):
        phases = [time for name, time in seconds.items() if name != "total"]
        assert sum(phases) == pytest.approx(seconds["total"], rel=1e-12)
