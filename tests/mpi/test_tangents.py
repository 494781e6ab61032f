"""Indefinite tangents on several ranks: the same choice, counts and refusals as on one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from fibres import FAR, subdomain
from lattice import box_stiffness
from prestressed import compression, pressed_block, stressed
from torn import POISSON, cube, fixed_nodes

from fenics_tfeti.errors import UnstableTangent
from fenics_tfeti.feti import (
    ContactRows,
    Options,
    Subdomain,
    TornSolver,
    TornSystem,
    prepare_tangents,
)

COMM = MPI.COMM_WORLD
STRESS = compression(3, 0.05)
BLOCKS: dict[str, dict[str, Any]] = {
    "2D": {"gdim": 2, "shape": (3, 3), "columns": 6, "layers": 4},
    "2D, slender": {"gdim": 2, "shape": (12, 2), "columns": 2, "layers": 6, "pressure": 0.1},
    "3D": {"gdim": 3, "columns": 4, "layers": 1},
    "2D, punch held by contact": {"gdim": 2, "columns": 5, "clamped": False},
}


def systems(name: str) -> tuple[TornSystem, TornSystem]:
    """Return the system on all ranks and the whole of it on this rank alone."""
    return tuple(
        prepare_tangents(pressed_block(**BLOCKS[name], comm=comm)) for comm in (COMM, MPI.COMM_SELF)
    )


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("name", list(BLOCKS))
def test_same_tangents_as_on_one_rank(name):
    dealt, alone = systems(name)
    for part, expected in zip(
        dealt.subdomains, alone.subdomains[COMM.rank :: COMM.size], strict=True
    ):
        assert part.kernel == expected.kernel
        assert abs(part.stiffness - expected.stiffness).max() <= 1e-13


@pytest.mark.parametrize(("name", "options"), [
    ("2D", {"coarse_solver": "distributed"}),
    ("2D, slender", {"method": "smalbe"}),
    ("3D", {}),
    ("2D, punch held by contact", {}),
], ids=lambda value: " ".join(value.values()) if isinstance(value, dict) else value)  # fmt: skip
def test_same_solution_and_counts_as_on_one_rank(name, options):
    chosen = Options(rtol=1e-8, **options)
    found, alone = (TornSolver(system, chosen).solve() for system in systems(name))
    if "method" not in options:
        for key in ("negative", "vectors"):
            assert found.report.deflation[key] == alone.report.deflation[key] > 0
        counts = [solution.report.products["total"] for solution in (found, alone)]
        assert abs(counts[0] - counts[1]) <= 1
    assert found.report.energy == pytest.approx(alone.report.energy, rel=1e-9)
    largest = max(np.abs(u).max() for u in alone.displacements)
    mine = alone.displacements[COMM.rank :: COMM.size]
    for u, expected in zip(found.displacements, mine, strict=True):
        np.testing.assert_allclose(u, expected, rtol=0.0, atol=1e-6 * largest)


@pytest.mark.ranks(2, 3)
def test_ranks_without_subdomains():
    alone = pressed_block()
    parts = alone if COMM.rank == 0 else pressed_block(comm=COMM)
    subdomains = alone.subdomains if COMM.rank == 0 else []
    prepared = prepare_tangents(replace(parts, subdomains=subdomains, comm=COMM))
    report = TornSolver(prepared, Options(rtol=1e-8)).solve().report
    expected = TornSolver(prepare_tangents(alone), Options(rtol=1e-8)).solve().report
    assert report.deflation["negative"] == expected.deflation["negative"]
    assert report.energy == pytest.approx(expected.energy, rel=1e-9)


def test_unstable_tangent_is_refused_on_all_ranks():
    system = pressed_block(2, 0.1, shape=(2, 12), columns=6, layers=1, comm=COMM)
    with pytest.raises(UnstableTangent, match="have 24 negative .* remove 23"):
        TornSolver(prepare_tangents(system, "exact"))
    found = TornSolver(prepare_tangents(system, "projected")).solve()
    assert found.report.converged


def test_preconditioner_is_chosen_as_on_one_rank():
    """An indefinite tangent on one rank, flat cells on the other: no Dirichlet preconditioner."""
    n, thin = 4, np.array([1.0, 1.0, 0.05])
    pressed = stressed(subdomain((0, 0, 0), (3, 2, 3), lambda x: np.ones(len(x)), 0), STRESS)
    flat = cube(n, body=1, first=FAR**3)
    flat = replace(
        flat, stiffness=box_stiffness(n, thin, POISSON), coordinates=thin * flat.coordinates
    )
    assert chosen_kind(MPI.COMM_SELF, replace(flat, body=0)) == "dirichlet"
    assert chosen_kind(MPI.COMM_SELF, pressed, flat) == "lumped"
    assert chosen_kind(COMM, (pressed, flat)[COMM.rank]) == "lumped"


def chosen_kind(comm: MPI.Intracomm, *parts: Subdomain) -> str:
    """Return the preconditioner of subdomains that are clamped at z = 0."""
    base = np.concatenate([s.nodes[s.coordinates[:, 2] == 0.0] for s in parts])
    system = TornSystem(
        list(parts), fixed_nodes(base, range(3)), ContactRows.none(3), 3, ["A", "B"], comm=comm
    )
    return TornSolver(prepare_tangents(system, "exact")).setup.choice.kind
