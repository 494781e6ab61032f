"""Which surfaces have pairs of nodes, and which mortar conditions."""

import numpy as np
import pytest
from scenes import MASTER, SLAVE
from strips import bend, matched, strips

from fenics_tfeti import Along, ContactPair, Mortar


def chosen(V, tags, **arguments):
    return matched(V, ContactPair(tags, SLAVE, MASTER, **arguments)).summary["discretisation"]


@pytest.mark.parametrize("gap", [0.0, 0.1, 3.0])
def test_equal_grids_match_at_any_distance(gap):
    V, tags = strips(gap=gap)
    assert chosen(V, tags) == "node_to_node"
    assert chosen(V, tags, partners=Mortar()) == "mortar"


@pytest.mark.parametrize("upper", [3, 5, 8, 2])
def test_other_grids_do_not(upper):
    """Also where the nodes of one grid are among those of the other."""
    V, tags = strips((4, 2), (upper, 2))
    assert chosen(V, tags) == "mortar"


@pytest.mark.parametrize(("shift", "expected"), [(1e-8, "node_to_node"), (1e-3, "mortar")])
def test_rounded_coordinates_match(shift, expected):
    V, tags = strips()
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + [shift, 0.0, 0.0])
    assert chosen(V, tags) == expected


@pytest.mark.parametrize(("rise", "expected"), [(0.02, "node_to_node"), (0.2, "mortar")])
def test_curved_face_above_a_plane(rise, expected):
    """The nodes are opposite each other along the plane's normal, and nearly along the slave's."""
    V, tags = strips()
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + np.outer(x[:, 0] ** 2, [0.0, rise, 0.0]))
    assert chosen(V, tags) == expected


def test_ways_to_find_partners_ask_for_nodes():
    V, tags = strips((4, 2), (2, 2))
    assert chosen(V, tags, partners=Along((0.0, 1.0))) == "node_to_node"
