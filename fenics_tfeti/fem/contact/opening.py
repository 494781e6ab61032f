"""Gaps of contact conditions after the solve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_tfeti.fem.contact.contact import ContactPairing
from fenics_tfeti.fem.contact.matching import contact_rows
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti.system import ContactRows
from fenics_tfeti.typing import Vector


def openings(
    nodes: NodeMap, pairings: Sequence[ContactPairing], displacement: Vector
) -> list[Vector]:
    """Return the openings (k,) of each contact's conditions, in order [m]. Collective.

    An opening is the gap less the approach of the surfaces along the slave's normal; infinite where
    there is no obstacle. The displacement (n,) is at the degrees of freedom that this rank owns
    [m].
    """
    rows = contact_rows(pairings, nodes.components)
    opening = (rows.gap - row_values(nodes, rows, displacement)) / rows.length
    ends = np.cumsum([pairing.slave.size for pairing in pairings])
    return np.split(opening, ends[:-1]) if len(pairings) else []


def row_values(nodes: NodeMap, rows: ContactRows, displacement: Vector) -> Vector:
    """Return sum_k c_k'u(node_k) of rows (k,) whose nodes may be on any rank. Collective.

    The displacement (n,) is at the degrees of freedom that this rank owns [m].
    """
    nodal = nodes.values_at(displacement.reshape(-1, nodes.components), rows.nodes)
    terms = np.sum(rows.coefficients * nodal, axis=1)
    sums = np.zeros(rows.size)
    np.add.at(sums, rows.row, terms)
    return sums
