"""Dense operators in float32, with residuals replaced in double."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from torn import column

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti import Options, TornSolver, dual, face


def options(precision: str, rtol: float, **others) -> Options:
    kind = "explicit" if precision == "single" else "auto"
    return Options(dual_operator=kind, operator_precision=precision, rtol=rtol, **others)


def solved(precision: str, rtol: float = 1e-10, **others):
    solver = TornSolver(column(height=3), options(precision, rtol, **others))
    return solver, solver.solve()


def two_classes():
    """Return three equal cubes and a softer one."""
    system = column(height=3)
    parts = list(system.subdomains)
    parts[1] = dataclasses.replace(parts[1], stiffness=0.3 * parts[1].stiffness)
    return dataclasses.replace(system, subdomains=parts)


def test_solution_is_that_of_double_precision():
    double, single = (solved(p)[1].displacements for p in ("double", "single"))
    scale = max(np.abs(u).max() for u in double)
    for u, expected in zip(single, double, strict=True):
        np.testing.assert_allclose(u, expected, rtol=0, atol=1e-10 * scale)


def test_without_replacement_there_is_no_such_accuracy(monkeypatch):
    monkeypatch.setattr(face, "_TRUSTED", 0.0)
    report = solved("single", error_if_not_converged=False)[1].report
    assert report.products["replacement"] == 0
    assert report.certificate.worst > 1e-9


@pytest.mark.parametrize(("rtol", "replacements"), [(1e-4, 0), (1e-8, 1), (1e-10, 1)])
def test_number_of_replacements(rtol, replacements):
    assert solved("single", rtol)[1].report.products["replacement"] == replacements


@pytest.mark.parametrize("rtol", [1e-4, 1e-8, 1e-10])
def test_iterations_are_as_many_as_in_double(rtol):
    double, single = (solved(p, rtol)[1].report.products["cg"] for p in ("double", "single"))
    assert abs(single - double) <= 2


def test_products_are_counted_by_precision(monkeypatch):
    solver = TornSolver(column(height=3), options("single", 1e-10))
    calls = dict.fromkeys(("part", "rough_part"), 0)

    def counted(name, apply):
        def counting(self, x):
            calls[name] += 1
            return apply(self, x)

        return counting

    for name in calls:
        apply = getattr(dual.DualOperator, name)
        monkeypatch.setattr(dual.DualOperator, name, counted(name, apply))
    products = solver.solve().report.products
    rough = products["cg"] + products["norm"]
    assert calls == {"part": products["replacement"], "rough_part": rough}
    assert products["total"] == products["replacement"] + products["cg"]


def test_limit_of_products_holds_with_replacements():
    report = solved("single", max_products=4, error_if_not_converged=False)[1].report
    assert report.products["total"] <= 4 + 1


def test_rough_product_has_the_accuracy_of_float32():
    F = solved("single")[0].F
    x = np.random.default_rng(0).standard_normal(F.constraints.multipliers.numbers.size)
    error = np.linalg.norm(F.rough_part(x) - F(x)) / np.linalg.norm(F(x))
    assert 1e-9 < error < 1e-6


def test_rough_product_in_double_is_the_product():
    F = solved("double")[0].F
    x = np.ones(F.constraints.multipliers.numbers.size)
    np.testing.assert_array_equal(F.rough_part(x), F(x))


@pytest.mark.parametrize(
    ("precision", "kinds"),
    [
        ("double", {"implicit": 1, "explicit": 1, "single": 0}),
        ("single", {"implicit": 1, "explicit": 0, "single": 1}),
    ],
)
def test_report_counts_classes_by_operator(monkeypatch, precision, kinds):
    monkeypatch.setattr(
        dual, "_explicit_pays", lambda inverse, boundary, members, entry: members > 1
    )
    report = TornSolver(two_classes(), Options(operator_precision=precision)).solve().report
    assert report.dual_operator == kinds
    assert report.certificate.worst <= 1e-6


def test_single_where_no_dense_matrix_pays_is_told(monkeypatch):
    """Everything is in double then, and the report says so."""
    monkeypatch.setattr(dual, "_explicit_pays", lambda *_: False)
    report = TornSolver(column(), Options(operator_precision="single")).solve().report
    assert report.dual_operator == {"implicit": 1, "explicit": 0, "single": 0}
    assert report.products["replacement"] == 0


@pytest.mark.parametrize("entry", [8, 4])
def test_counted_bytes_are_those_of_the_precision(monkeypatch, entry):
    entries = []

    def pays(inverse, boundary, members, entry):
        entries.append(entry)
        return True

    monkeypatch.setattr(dual, "_explicit_pays", pays)
    TornSolver(column(), Options(operator_precision={8: "double", 4: "single"}[entry]))
    assert entries == [entry]


@pytest.mark.parametrize("other", [{"dual_operator": "implicit"}, {"method": "smalbe"}])
def test_options_that_leave_nothing_to_single_precision(other):
    (name,) = other
    with pytest.raises(InputError, match=f"operator_precision='single' does nothing with {name}="):
        Options(operator_precision="single", **other)
