"""Mortar conditions and their solutions are those of one process, on any number of ranks."""

from itertools import cycle

from mpi4py import MPI

import numpy as np
import pytest
from mortar_blocks import LOADED, LOWER, PRESSURE, SUPPORTED, UPPER, Blocks, solved, uneven
from mortar_feet import TABLE, foot_on_table

import ufl

from fenics_tfeti import TiedPair
from fenics_tfeti.parallel import concatenate_ranks

COMM = MPI.COMM_WORLD
CASES = {
    "triangle": Blocks("triangle", 6, 8, width=0.63),
    "tetrahedron": Blocks("tetrahedron", 3, 4, width=0.63, jitter=0.2),
    "hexahedron": Blocks("hexahedron", 3, 4, jitter=0.05),
    "tetrahedron of degree 2": Blocks("tetrahedron", 2, 3, jitter=0.2, degree=2),
}


@pytest.mark.parametrize(("cell", "slave"), list(zip(CASES, cycle((LOWER, UPPER)), strict=False)))
def test_patch(cell, slave):
    result = solved(CASES[cell], slave, COMM)
    assert result.displacement < 1e-10
    assert result.pressure < 1e-8


def by_place(problem):
    """Return the contact's fields, in the order of places, on every rank."""
    contact = problem.results[0].gather()
    order = np.lexsort(np.round(contact.coordinates, 9).T)
    names = ("coordinates", "gap", "normal", "nodal_normal_force", "pressure", "area", "coverage")
    return {name: getattr(contact, name)[order] for name in names}


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron of degree 2"])
def test_uneven_load(cell):
    """Curved upper block under half a load: gaps, normals and active sets vary."""
    here, alone = uneven(CASES[cell], COMM), uneven(CASES[cell], MPI.COMM_SELF)
    found, expected = by_place(here), by_place(alone)
    assert 0 < np.count_nonzero(expected["pressure"]) < expected["pressure"].size
    for name, values in expected.items():
        scale = np.abs(values).max()
        np.testing.assert_allclose(found[name], values, rtol=0.0, atol=1e-8 * scale, err_msg=name)
    (entry,), (other,) = (
        [c.matching for c in here.report.contacts],
        [c.matching for c in alone.report.contacts],
    )
    assert entry["discretisation"] == other["discretisation"] == "mortar"
    numbers = {key for key, value in other.items() if isinstance(value, int | float)}
    assert {key: entry[key] for key in numbers} == pytest.approx(
        {key: other[key] for key in numbers}, rel=1e-8, abs=1e-10
    )


def test_roles_are_those_of_one_rank():
    """The fine upper surface, given as slave, has the larger E / h."""
    blocks, pair = Blocks("quadrilateral", 4, 24), {"roles": "auto"}
    problems = [uneven(blocks, comm, UPPER, pair) for comm in (COMM, MPI.COMM_SELF)]
    found, alone = (problem.report.contacts[0] for problem in problems)
    assert found.roles == alone.roles
    assert "are exchanged" in found.roles
    assert found.matching["slave"] == alone.matching["slave"] == LOWER
    sides = [problem.report.contacts[0].force for problem in problems]
    np.testing.assert_allclose(*sides, rtol=1e-5, atol=1e-6 * np.abs(sides).max())
    assert sides[0][1] > 0.0


@pytest.mark.ranks(2, 3)
def test_rows_are_at_the_owners_of_slave_nodes():
    problem = uneven(CASES["triangle"], COMM)
    first, last = problem.space.dofmap.index_map.local_range
    nodes = problem.results[0].nodes
    assert ((nodes >= first) & (nodes < last)).all()
    every = concatenate_ranks(COMM, nodes)
    assert np.unique(every).size == every.size


def pulled(comm):
    """Two tied blocks under a load that grows with x."""
    scene = CASES["tetrahedron"].scene(comm)
    load = scene.constant(PRESSURE) * ufl.SpatialCoordinate(scene.mesh)[0]
    scene.L = load * scene.v[2] * scene.ds(LOADED)
    scene.fix(SUPPORTED[2])
    scene.fix(SUPPORTED[0], 0)
    scene.contacts = TiedPair(scene.facet_tags, LOWER, UPPER)
    options = {"rtol": 1e-11, "subdomain_size": 150}
    V, problem = scene.V, scene.problem(cell_tags=None, options=options)
    x = problem.solve().x.array.reshape(-1, 3)[: V.dofmap.index_map.size_local]
    place = V.tabulate_dof_coordinates()[: len(x)]
    body = np.round(problem.report.contacts[0].force, 3)
    return concatenate_ranks(comm, np.column_stack([place, x])), body


def test_tied_blocks():
    (here, force), (alone, expected) = pulled(COMM), pulled(MPI.COMM_SELF)
    # the nodes of both blocks at one place differ: order by the displacements as well
    order = [np.lexsort(np.round(rows / np.abs(rows).max(axis=0), 7).T) for rows in (here, alone)]
    scale = np.abs(alone).max(axis=0)
    np.testing.assert_allclose(here[order[0]] / scale, alone[order[1]] / scale, atol=1e-6)
    np.testing.assert_allclose(force, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
def test_rim(cell):
    """Facets at nodes beside the foot belong to several ranks; pressures are means over nodes."""
    problems = [foot_on_table(cell, (8, 6), 0.03, TABLE, comm) for comm in (COMM, MPI.COMM_SELF)]
    here, alone = map(by_place, problems)
    assert alone["coverage"].min() < 0.1
    depths = [problem.report.contacts[0].penetration for problem in problems]
    assert 0.0 < depths[0] == pytest.approx(depths[1], rel=1e-5)
    for name in ("coordinates", "area", "nodal_normal_force", "coverage", "pressure"):
        scale = np.abs(alone[name]).max()
        np.testing.assert_allclose(here[name], alone[name], rtol=0.0, atol=1e-6 * scale)
