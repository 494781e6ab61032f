"""Gaps after the solve, of pairs of nodes, mortar conditions and obstacles."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import LOADED, MASTER, SLAVE, dimension, fixed, pressed_block, two_beams
from stepped_blocks import two_blocks

from fenics_tfeti import ContactPair, Deformed, Mortar, Nearest
from fenics_tfeti.io import contact_fields

COMM = MPI.COMM_WORLD
each_kind = pytest.mark.parametrize("partners", [Nearest(), Mortar()], ids=["nodes", "mortar"])


@each_kind
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_bodies_that_do_not_touch(cell, partners):
    """The upper body is translated down by less than the gap."""
    scene, up = two_beams(COMM, cell, 2, gap=0.1), dimension(cell) - 1
    scene.traction.value = 0.0
    moved = [fixed(scene.V, scene.facet_tags, LOADED, k, -0.03 * (k == up)) for k in range(up + 1)]
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, partners=partners)
    problem = scene.problem(bcs=[scene.bcs[0], *moved], contacts=pair)
    problem.solve()
    (contact,) = problem.results
    np.testing.assert_allclose(contact.gap, 0.1, rtol=1e-12)
    np.testing.assert_allclose(contact.opening, 0.07, rtol=1e-8)
    assert not contact.active.any()


def test_closed_contact_of_matching_meshes():
    """The opening is the distance of the deformed nodes along the normal."""
    scene = two_beams(COMM, "quadrilateral", 6)
    problem = scene.problem(options={"rtol": 1e-9})
    uh = problem.solve()
    (contact,), scale = problem.results, np.abs(uh.x.array).max()
    down = uh.x.array.reshape(-1, 2)[:, 1]
    x = scene.V.tabulate_dof_coordinates()
    for node, opening in zip(contact.nodes, contact.opening, strict=True):
        both = np.flatnonzero(np.all(np.isclose(x, x[node]), axis=1))
        (master,) = both[both != node]
        assert opening == pytest.approx(down[node] - down[master], abs=1e-14 * scale)
    np.testing.assert_allclose(contact.opening[contact.active], 0.0, atol=1e-12 * scale)
    assert contact.opening.max() > 1e-4 * scale
    assert contact.opening.min() > -1e-12 * scale


@pytest.mark.parametrize("approach", [3e-3, 5e-3])
def test_obstacle(approach):
    scene = pressed_block(COMM, "quadrilateral", approach=approach, gap=4e-3)
    problem = scene.problem(options={"rtol": 1e-9})
    problem.solve()
    np.testing.assert_allclose(problem.results[0].opening, max(4e-3 - approach, 0.0), atol=1e-12)


@pytest.mark.parametrize("upper", [12, 9], ids=["node_to_node", "mortar"])
def test_exact_contact_is_closed_in_the_last_pass(upper):
    gaps = Deformed(max_passes=40)
    problem = two_blocks(0.3, {"rtol": 1e-8}, upper=upper, gaps=gaps)
    scale = np.abs(problem.solve().x.array).max()
    (contact,) = problem.results
    assert contact.active.any()
    np.testing.assert_allclose(contact.opening[contact.active], 0.0, atol=1e-10 * scale)


def test_field_is_that_of_the_nearest_contact():
    scene = two_beams(COMM, "quadrilateral", 4)
    problem = scene.problem()
    problem.solve()
    (contact,) = problem.results
    fields = contact_fields(scene.V, [contact, contact])
    elsewhere = np.setdiff1d(np.arange(fields.gap.x.array.size), contact.nodes)
    for field, values in ((fields.opening, contact.opening), (fields.gap, contact.gap)):
        np.testing.assert_array_equal(field.x.array[contact.nodes], values)
        assert np.isnan(field.x.array[elsewhere]).all()
    assert np.isfinite(fields.pressure.x.array).all()


@pytest.mark.ranks(2)
@pytest.mark.parametrize("upper", [12, 9], ids=["node_to_node", "mortar"])
def test_openings_are_those_of_one_rank(upper):
    problems = [
        two_blocks(0.3, {"rtol": 1e-9}, comm=comm, upper=upper) for comm in (COMM, MPI.COMM_SELF)
    ]
    scale = max(COMM.allgather(np.abs(problems[0].solve().x.array).max()))
    problems[1].solve()
    found, expected = (problem.results[0].gather() for problem in problems)
    order, expected_order = (np.argsort(c.coordinates[:, 0]) for c in (found, expected))
    opening = expected.opening[expected_order]
    assert opening.max() > 1e-3 * scale
    np.testing.assert_allclose(found.opening[order], opening, atol=1e-7 * scale)
