"""The tests mirror the package: fenics_tfeti/a/b.py is tested by tests/a/test_b.py."""

from __future__ import annotations

from pathlib import Path

import pytest

pytestmark = pytest.mark.once

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "fenics_tfeti"

# Modules without a test file of their own, and where they are tested.
ELSEWHERE = {
    "fem/io/tagged_mesh.py": "data only",
    "fem/tolerances.py": "constants only",
    "feti/body_checks.py": "tests/feti/test_system.py",
    "feti/constraints/entries.py": "tests/feti/constraints/test_rows.py",
    "feti/constraints/equality.py": "tests/feti/constraints/test_rows.py",
    "feti/constraints/conditions.py": "tests/feti/constraints/test_rows.py",
    "feti/dual/pcpg.py": "tests/feti/dual/test_active_set.py",
    "feti/dual/problem.py": "data only",
    "feti/options.py": "tests/test_options.py, tests/test_errors.py",
    "feti/report.py": "tests/feti/test_solver.py",
    "feti/solution/setup.py": "tests/feti/test_solver.py",
    "feti/solution/states.py": "data only",
    "feti/system_checks.py": "tests/feti/test_system.py",
    "feti/tolerances.py": "constants only",
    "problem.py": "tests/verification, tests/mpi and tests/demos solve whole problems",
    "report.py": "tests/fem/contact/test_pairing_summary.py reads it from a solved problem",
}
# Tests of what several modules do together.
TOGETHER = {
    "feti/test_friction.py",
    "feti/test_sparse_rows.py",
    "feti/test_springs.py",
    "feti/test_units.py",
    "feti/coarse/test_motions.py",
}

MODULES = sorted(
    path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if not path.name.startswith("_")
)
TEST_FILES = sorted(
    path.relative_to(TESTS)
    for layer in ("qp", "feti", "fem")
    for path in (TESTS / layer).rglob("test_*.py")
    if path.relative_to(TESTS).as_posix() not in TOGETHER
)


def has_test(module: Path) -> bool:
    """Tell whether a module has a test file on one rank, or one for several ranks."""
    name = f"test_{module.name}"
    return (TESTS / module.with_name(name)).is_file() or (TESTS / "mpi" / name).is_file()


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_module_is_tested(module):
    if module.as_posix() in ELSEWHERE:
        assert not has_test(module), "it has a test file: take it out of ELSEWHERE"
    else:
        assert has_test(module)


def test_exceptions_are_modules():
    assert set(ELSEWHERE) <= {module.as_posix() for module in MODULES}


@pytest.mark.parametrize("test", TEST_FILES, ids=str)
def test_test_file_belongs_to_a_module(test):
    name = test.name.removeprefix("test_")
    folder = PACKAGE / test.parent
    assert (folder / name).is_file() or (folder / f"_{name}").is_file()
