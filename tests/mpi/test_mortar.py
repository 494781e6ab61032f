"""Mortar conditions and their solutions are those of one process, on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from mortar_blocks import LOWER, UPPER, Blocks, solved, uneven

from fenics_tfeti.parallel import concatenate_ranks

COMM = MPI.COMM_WORLD
CASES = {
    "triangle": Blocks("triangle", 6, 8, width=0.63),
    "tetrahedron": Blocks("tetrahedron", 3, 4, width=0.63, jitter=0.2),
    "hexahedron": Blocks("hexahedron", 3, 4, jitter=0.05),
}
every_case = pytest.mark.parametrize("cell", CASES)


@every_case
@pytest.mark.parametrize("slave", [LOWER, UPPER])
def test_patch(cell, slave):
    result = solved(CASES[cell], slave, COMM)
    assert result.displacement < 1e-10
    assert result.pressure < 1e-8


def by_place(problem):
    """Return the contact's fields, in the order of places, on every rank."""
    contact = problem.contact[0].gather()
    order = np.lexsort(np.round(contact.coordinates, 9).T)
    names = ("coordinates", "gap", "normal", "normal_force", "pressure", "area")
    return {name: getattr(contact, name)[order] for name in names}


@every_case
def test_uneven_load(cell):
    """Curved upper block under half a load: gaps, normals and active sets vary."""
    here, alone = uneven(CASES[cell], COMM), uneven(CASES[cell], MPI.COMM_SELF)
    found, expected = by_place(here), by_place(alone)
    assert 0 < np.count_nonzero(expected["pressure"]) < expected["pressure"].size
    for name, values in expected.items():
        scale = np.abs(values).max()
        np.testing.assert_allclose(found[name], values, rtol=0.0, atol=1e-8 * scale, err_msg=name)
    for entry, other in zip(here.report.pairing, alone.report.pairing, strict=True):
        assert entry.pop("contact") == other.pop("contact")
        assert entry.pop("discretisation") == other.pop("discretisation") == "mortar"
        assert entry == pytest.approx(other, rel=1e-8, abs=1e-10)


def test_rows_are_at_the_owners_of_slave_nodes():
    problem = uneven(CASES["triangle"], COMM)
    first, last = problem.space.dofmap.index_map.local_range
    nodes = problem.contact[0].nodes
    assert ((nodes >= first) & (nodes < last)).all()
    every = concatenate_ranks(COMM, nodes)
    assert np.unique(every).size == every.size
