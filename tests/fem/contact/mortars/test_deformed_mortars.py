"""Mortar conditions with normals and gaps, also on deformed surfaces."""

import numpy as np
import pytest
from matching import match_contacts
from mortar_blocks import Blocks, uneven
from scenes import MASTER, SLAVE
from strips import bend, matched, strips

from dolfinx.fem import Function

from fenics_tfeti import ContactPair, Deformed
from fenics_tfeti.fem.contact.conditions.contact_conditions import Terms
from fenics_tfeti.fem.contact.conditions.deformed import deformed_contacts
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary

TERMS = Terms(
    offsets=np.array([0, 3, 6]),
    nodes=np.array([2, 5, 4, 1, 3, 4]),
    weights=np.array([2.0, -0.5, -1.5, 1.0, 0.5, -1.5]),
    slaves=np.array([1, 2]),
)


def test_scale_is_the_sum_of_the_slave_terms():
    np.testing.assert_array_equal(TERMS.scale, [2.0, 1.5])


def test_main_master_has_the_largest_weight():
    assert TERMS.master.tolist() == [4, 4]


def test_means():
    values = TERMS.nodes[:, None].astype(float)
    first = (2.0 * 2 - 0.5 * 5 - 1.5 * 4) / 2.0
    second = (1.0 * 1 + 0.5 * 3 - 1.5 * 4) / 1.5
    np.testing.assert_allclose(TERMS.means(values)[:, 0], [first, second])


def test_terms_of_nodes():
    slave, master = np.array([3, 5, 6]), np.array([7, 1, 4])
    pairs, single = Terms.of_nodes(slave, master), Terms.of_nodes(slave)
    values = np.arange(8.0)[:, None] ** 2
    for terms, expected in ((pairs, master), (single, [-1, -1, -1])):
        np.testing.assert_array_equal(terms.slave, slave)
        np.testing.assert_array_equal(terms.master, expected)
        np.testing.assert_array_equal(terms.scale, 1.0)
    np.testing.assert_array_equal(pairs.means(values[pairs.nodes]), values[slave] - values[master])
    np.testing.assert_array_equal(single.means(values[slave]), values[slave])


@pytest.mark.parametrize("gap", [0.1, 0.0, 2.0])
def test_gap_of_parallel_surfaces(gap):
    V, tags = strips((4, 2), (7, 2), gap=gap)
    conditions = matched(V, ContactPair(tags, SLAVE, MASTER))
    np.testing.assert_allclose(conditions.gap, gap, atol=1e-14)
    np.testing.assert_allclose(conditions.normal, np.tile([0.0, -1.0], (8, 1)), atol=1e-15)
    assert conditions.summary["largest_angle"] == pytest.approx(0.0, abs=1e-10)
    assert conditions.summary["largest_distance"] is None


def test_deformed_surfaces():
    """The upper strip moves down by 0.04 and to the right by 0.3, where it is off the lower one."""
    V, tags = strips((4, 2), (7, 2))
    pair = ContactPair(tags, SLAVE, MASTER)
    before = matched(V, pair)
    uh = Function(V)
    x = V.tabulate_dof_coordinates()
    uh.x.array.reshape(-1, 2)[x[:, 1] > 1.05] = [0.3, -0.04]
    state = deformed_contacts([(pair, before)], uh)[0]
    after = state.conditions
    assert after.slave.size < before.slave.size
    # in terms of the total displacement: (u_slave - u_master)'n = 0.04 of the gap of 0.1 is used
    np.testing.assert_allclose(after.gap, 0.1)
    assert after.area.sum() == pytest.approx(0.7)
    still = np.isin(before.slave, after.slave)
    np.testing.assert_allclose(state.distance[still], 0.06)
    np.testing.assert_allclose(state.distance[~still], 1.0 / 7.0)
    assert (state.penetration == 0.0).all()
    np.testing.assert_allclose(state.slip[still], 2.1)
    np.testing.assert_allclose(state.slip[~still], 1.0)


def test_exact_passes_close_the_deformed_surfaces():
    problem = uneven(Blocks("triangle", 6, 8, width=0.63), gaps=Deformed())
    assert problem.report.converged
    assert problem.report.passes[-1].error <= 1e-3


def test_start_from_a_coarse_mesh():
    coarse = uneven(Blocks("triangle", 5, 6, width=0.63))
    fine = uneven(Blocks("triangle", 15, 18, width=0.63))
    expected = fine.results[0]
    faces = len(fine.report.faces)
    fine.solve(coarse=coarse)
    np.testing.assert_allclose(
        fine.results[0].pressure, expected.pressure, atol=1e-7 * expected.pressure.max()
    )
    assert len(fine.report.faces) <= faces


def test_moved_mesh_is_integrated_again():
    problem = uneven(Blocks("triangle", 6, 8))
    first = problem.results[0]
    problem.space.mesh.geometry.x[:, 0] *= 2.0
    problem.solve()
    assert problem.results[0].area.sum() == pytest.approx(2.0 * first.area.sum(), rel=1e-3)


def test_same_conditions_where_nothing_changed():
    problem = uneven(Blocks("triangle", 6, 8))
    rows = problem.system.contacts
    problem.solve()
    np.testing.assert_array_equal(problem.system.contacts.coefficients, rows.coefficients)


@pytest.mark.parametrize("slope", [0.4, 1.0])
def test_faces_of_a_slave_are_matched_apart(slope):
    """The slave has an edge in its middle, at which it turns by more than 60 degrees."""
    V, tags = strips((4, 2), (2, 2))
    middle = lambda x: np.isclose(x[:, 0], 0.5) & np.isclose(x[:, 1], 1.1)  # noqa: E731
    bend(V, middle, lambda x: x - [0.0, slope, 0.0])
    left, right = match_contacts(MeshBoundary.of(V), [ContactPair(tags, SLAVE, MASTER)])
    normal = np.array([2.0 * slope, 1.0]) / np.hypot(2.0 * slope, 1.0)
    np.testing.assert_allclose(left.normal, [-normal, -normal], rtol=1e-12)
    np.testing.assert_allclose(right.normal, 2 * [normal * [1.0, -1.0]], rtol=1e-12)
