"""Surfaces that are several tags, or names, joined."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import MASTER, SLAVE, two_beams

from dolfinx.mesh import compute_midpoints, meshtags

from fenics_tfeti import ContactPair, ContactProblem, InputError
from fenics_tfeti.fem.topology import with_tag_names

LEFT, RIGHT, NOWHERE = 71, 72, 73
NAMES = {LEFT: "left half", RIGHT: "right half", MASTER: "base"}


@pytest.fixture(scope="module")
def halves():
    """Return two beams, their solution, and tags that cut the slave into two."""
    scene = two_beams(MPI.COMM_WORLD, "quadrilateral", 4)
    tags = scene.facet_tags
    middles = compute_midpoints(scene.mesh, 1, tags.indices)
    half = np.where(middles[:, 0] < 1.5, LEFT, RIGHT)
    values = np.where(tags.values == SLAVE, half, tags.values).astype(np.int32)
    cut = with_tag_names(meshtags(scene.mesh, 1, tags.indices, values), NAMES)
    return scene, scene.problem().solve().x.array.copy(), cut


def solved(scene, contact):
    problem = ContactProblem(
        scene.a, scene.L, bcs=scene.bcs, contacts=contact, cell_tags=scene.cell_tags
    )
    return problem.solve().x.array, problem


@pytest.mark.ranks(1, 2)
@pytest.mark.parametrize("slave", [[LEFT, RIGHT], (RIGHT, LEFT, RIGHT), ["left half", RIGHT]])
def test_a_list_joins_surfaces(halves, slave):
    scene, exact, cut = halves
    u, problem = solved(scene, ContactPair(cut, slave, "base"))
    np.testing.assert_allclose(u, exact, rtol=0, atol=1e-9 * np.abs(exact).max())
    assert problem.report.contacts[0].normal_force == pytest.approx(scene.total_forces[0])


@pytest.mark.parametrize("tag", [SLAVE, [SLAVE]])
def test_a_list_of_one_tag_is_the_tag(halves, tag):
    scene = halves[0]
    assert ContactPair(scene.facet_tags, tag, [MASTER]) == ContactPair(
        scene.facet_tags, SLAVE, MASTER
    )


@pytest.mark.ranks(1, 2)
def test_a_tag_of_a_list_that_is_on_no_facet_is_named(halves):
    scene, _, cut = halves
    with pytest.raises(InputError, match=f"tag {NOWHERE} is on no facet"):
        solved(scene, ContactPair(cut, [LEFT, NOWHERE], MASTER))


def test_a_tag_of_both_surfaces_is_an_error(halves):
    with pytest.raises(InputError, match=f"slave and master have the same tag {RIGHT}"):
        ContactPair(halves[2], [LEFT, RIGHT], [MASTER, RIGHT])


@pytest.mark.parametrize("tags", [[], {LEFT}, [LEFT, 2.5]])
def test_what_is_no_list_of_tags(halves, tags):
    with pytest.raises(InputError, match="A list stands for several tags"):
        ContactPair(halves[2], tags, MASTER)
