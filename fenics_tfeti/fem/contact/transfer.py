"""Where contact is to be expected, from the solution of the same problem on another mesh.

Pressures and the surfaces' approach to each other depend little on the mesh. They are interpolated
on the facets of the other mesh's slave surfaces; forces and gaps follow with the areas and the
initial gaps of this mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.contact import Contact, ContactResult, MatchedContact, RigidObstacle
from fenics_tfeti.fem.contact.deformed import MovedSurface, gather_surface
from fenics_tfeti.feti import ContactGuess
from fenics_tfeti.parallel import concatenate_ranks

__all__ = ["SolvedContact", "check_same_contacts", "expected_contact", "gather_solved"]

Vector = NDArray[np.float64]

# of interpolation weights: the share of matched nodes that counts as none
_ROUNDING = 1e-9


@dataclass(frozen=True)
class SolvedContact:
    """The solution on a slave's surface, of all ranks, on every rank.

    Attributes
    ----------
    name : str
        Name of the contact.
    surface : MovedSurface
        Nodes and facets.
    matched : (n,) bool array
        Nodes that have a contact condition.
    pressure : (n,) array
        [Pa]; 0 elsewhere.
    approach : (n,) array
        (u_slave - u_master)'n [m]; 0 elsewhere.
    """

    name: str
    surface: MovedSurface
    matched: NDArray[np.bool_]
    pressure: Vector
    approach: Vector


def gather_solved(
    contacts: Sequence[Contact],
    matched: Sequence[MatchedContact],
    results: Sequence[ContactResult],
    displacement: Function,
) -> list[SolvedContact]:
    """Gather the solution on the slaves' surfaces on every rank.

    Collective. The surfaces are those of a coarse mesh; what is sent grows with them.

    Parameters
    ----------
    contacts : sequence of ContactPair or RigidObstacle
        What may touch.
    matched : sequence of MatchedContact
        Their nodes and normals.
    results : sequence of ContactResult
        Their pressures.
    displacement : Function
        The solution [m].
    """
    displacement.x.scatter_forward()
    return [
        _gather_solved(*one, displacement) for one in zip(contacts, matched, results, strict=True)
    ]


def _gather_solved(
    contact: Contact, matched: MatchedContact, result: ContactResult, displacement: Function
) -> SolvedContact:
    space = displacement.function_space
    comm = space.mesh.comm
    slave = gather_surface(space, contact.facet_tags, contact.slave, displacement)
    columns = (matched.slave, matched.master, matched.normal, result.pressure)
    nodes, master, normal, of_matched = (concatenate_ranks(comm, column) for column in columns)
    at = np.searchsorted(slave.nodes, nodes)
    relative = slave.displacement[at]
    if not isinstance(contact, RigidObstacle):
        other = gather_surface(space, contact.facet_tags, contact.master, displacement)
        relative = relative - other.displacement[np.searchsorted(other.nodes, master)]
    n = slave.nodes.size
    there, pressure, approach = np.zeros(n, dtype=bool), np.zeros(n), np.zeros(n)
    there[at], pressure[at] = True, of_matched
    approach[at] = np.sum(relative * normal, axis=1)
    return SolvedContact(matched.name, slave, there, pressure, approach)


def expected_contact(
    solved: Sequence[SolvedContact], matched: Sequence[MatchedContact]
) -> ContactGuess:
    """Transfer forces and gaps to the contact rows of another mesh.

    Parameters
    ----------
    solved : sequence of SolvedContact
        The solution on a coarse mesh.
    matched : sequence of MatchedContact
        The same contacts on the present mesh, this rank's part.

    Returns
    -------
    ContactGuess
        For this rank's contact rows, contact by contact.
    """
    parts = [_transferred(*one) for one in zip(solved, matched, strict=True)]
    none = np.zeros(0)
    force = np.concatenate([none, *(force for force, _ in parts)])
    return ContactGuess(force, np.concatenate([none, *(gap for _, gap in parts)]))


def _transferred(solved: SolvedContact, matched: MatchedContact) -> tuple[Vector, Vector]:
    """Return normal forces [N] and remaining gaps [m]; no force far from all matched nodes."""
    values = np.column_stack([solved.matched, solved.pressure, solved.approach])
    points = matched.coordinates[:, : matched.normal.shape[1]]
    weight, pressure, approach = solved.surface.interpolate(values, points).T
    near = weight > _ROUNDING
    weight = np.where(near, weight, 1.0)
    force = np.where(near, pressure / weight * matched.area, 0.0)
    return force, np.where(near, matched.gap - approach / weight, np.inf)


def check_same_contacts(solved: Sequence[str], present: Sequence[str]) -> None:
    """Check that two meshes have the same contacts.

    Parameters
    ----------
    solved, present : sequences of str
        Names of the contacts on the coarse mesh and on the present one.

    Raises
    ------
    InputError
        With both lists.
    """
    if list(solved) != list(present):
        raise InputError(
            f"the coarse problem has the contacts {list(solved)}, this one has {list(present)}: "
            "give both problems the same contacts in the same order, under the same names"
        )
