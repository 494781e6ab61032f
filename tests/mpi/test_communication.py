"""What an iteration sends, counted on the communicator (`benchmarks/communication.py`)."""

from __future__ import annotations

import importlib
import sys
from functools import lru_cache
from pathlib import Path

from mpi4py import MPI

import pytest
from torn import column

from fenics_tfeti.feti import Options

comm = MPI.COMM_WORLD
pytestmark = pytest.mark.ranks(2, 3)

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
communication = importlib.import_module("communication")

METHODS = {
    "active_set": {},
    "smalbe": {"method": "smalbe", "preconditioner": "none"},
    "smalbe, lumped": {"method": "smalbe", "rtol": 1e-9},
}
# (reductions of few numbers, coarse vectors, exchanges of multipliers and of coarse unknowns)
WANTED = {
    ("active_set", "redundant"): (1, 2, 2, 0),
    ("active_set", "distributed"): (3, 0, 2, 2),
    ("smalbe", "redundant"): (2, 2, 1, 0),
    ("smalbe", "distributed"): (2, 0, 1, 2),
    ("smalbe, lumped", "redundant"): (3, 4, 2, 0),
    ("smalbe, lumped", "distributed"): (3, 0, 2, 4),
}


@lru_cache(maxsize=None)
def measured(method: str, solver: str) -> dict:
    system = communication.dealt(column(n=2, height=3), comm)
    return communication.measure(system, Options(coarse_solver=solver, **METHODS[method]))


@pytest.mark.parametrize(("method", "solver"), WANTED)
def test_calls_of_an_iteration(method, solver):
    """No iteration sends objects."""
    found = measured(method, solver)
    names = ("reductions", "coarse", "exchanges", "coarse_exchanges")
    assert tuple(found["iteration"][name] for name in names) == WANTED[method, solver]
    assert found["mean"]["pickled"] == found["mean"]["all_to_all"] == 0


def test_sizes_and_numbers_of_messages():
    """The coarse vector comes with an inner product; there is a message for each neighbour.

    The column is dealt in layers: a rank has two neighbours at most.
    """
    found = measured("active_set", "redundant")
    iteration = found["iteration"]
    assert iteration["coarse_bytes"] == 2 * 8 * (found["coarse"] + 1)
    assert iteration["messages"] == iteration["exchanges"] * min(2, comm.size - 1)
