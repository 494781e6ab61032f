"""Forces at the end of Newton's method: of its last multipliers, along the last normals.

The last linearised problem has the normals, areas and places before the last step.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fenics_tfeti.feti.report.resultants import Resultant, RowForces, moments
from fenics_tfeti.feti.solver import TornSolution
from fenics_tfeti.newton.equilibrium import DeformedRows, Multipliers
from fenics_tfeti.typing import Numbers, Vector


def solution_at(
    rows: DeformedRows,
    multipliers: Multipliers,
    internal: Vector,
    displacement: Vector,
    last: TornSolution,
) -> TornSolution:
    """Return the last solution with the forces of multipliers in other rows. Collective.

    The report has their sums, and reactions that balance them and the internal forces less loads
    (owned, gdim) at a displacement (owned, gdim).
    """
    contact_set, friction = rows.contact_set, rows.friction
    nodes, place = contact_set.boundary.nodes, rows.place[friction.row]
    normal, tied = rows.normal_forces(multipliers), multipliers.tied
    tangential = rows.friction_forces(multipliers)
    sticking = ~multipliers.slipping[place]
    plastic = np.where(sticking[:, None], 0.0, rows.slip)
    slip = np.where(np.asarray(friction.compliance)[:, None] > 0.0, rows.slip, plastic)
    x = nodes.coordinates + displacement
    beyond = np.append(rows.contacts.nodes, rows.tied.nodes)
    unknowns = np.setdiff1d(beyond[beyond >= nodes.total], _corners(rows)[0])
    forces = RowForces.of(rows.contacts, rows.tied, friction, (normal, tied, tangential), unknowns)
    contact = rows.contacts.contact[friction.row]
    work = np.zeros(len(contact_set.names))
    np.add.at(work, contact, np.sum(tangential * plastic, axis=1))
    points = _points(rows, x, forces.rows.nodes)
    contacts = forces.of_contacts(rows.contacts, contact_set.names, points, work, nodes.comm)
    supports = internal + rows.force(multipliers)[0]
    names = [reaction.name for reaction in last.report.reactions]
    report = replace(last.report, contacts=contacts, reactions=_reactions(rows, x, supports, names))
    return replace(
        last,
        normal_force=normal,
        active=normal > 0.0,
        tied_force=tied,
        tangential_force=tangential,
        slip=slip,
        sticking=sticking,
        slip_bound=rows.slip_bounds(multipliers),
        report=report,
    )


def _corners(rows: DeformedRows) -> tuple[Numbers, Vector]:
    """Return the numbers (c,) of the corners of rigid bodies, and where they are (c, gdim)."""
    bodies = rows.contact_set.bodies
    numbers = [np.zeros(0, dtype=np.int64), *(frame.nodes for frame in bodies.frames)]
    places = [np.zeros((0, bodies.gdim)), *(frame.corners for frame in bodies.frames)]
    return np.concatenate(numbers), np.concatenate(places)


def _points(rows: DeformedRows, x: Vector, numbers: Numbers) -> Vector:
    """Return the places (k, gdim) of nodes of rows; zero for those that are unknowns. Collective.

    Those of the mesh are at x (owned, gdim).
    """
    nodes, (corners, places) = rows.contact_set.boundary.nodes, _corners(rows)
    points = np.zeros((numbers.size, nodes.components))
    in_mesh, on_bodies = numbers < nodes.total, np.isin(numbers, corners)
    points[in_mesh] = nodes.values_at(x, numbers[in_mesh])
    order = np.argsort(corners)
    position = np.searchsorted(corners, numbers[on_bodies], sorter=order)
    points[on_bodies] = places[order[position]]
    return points


def _reactions(
    rows: DeformedRows, x: Vector, supports: Vector, names: list[str]
) -> list[Resultant]:
    """Return the sums of forces (owned, gdim) of each Dirichlet condition. Collective."""
    nodes, prescribed = rows.contact_set.boundary.nodes, rows.contact_set.prescribed
    gdim, number = nodes.components, np.asarray(prescribed.condition, dtype=np.int64)
    # of several conditions for one displacement the last one counts
    columns = np.full((number.size, gdim), -1)
    columns[np.arange(number.size), prescribed.components] = number
    of_nodes = nodes.reduce_at_owners(prescribed.nodes, columns + 1, np.maximum) - 1
    sums = np.zeros((len(names), gdim + {2: 1, 3: 3}[gdim]))
    for k, total in enumerate(sums):
        force = np.where(of_nodes == k, supports, 0.0)
        total[:] = np.append(force.sum(axis=0), moments(x, force).sum(axis=0))
    sums = nodes.comm.allreduce(sums)
    return [
        Resultant(name, total[:gdim], total[gdim:])
        for name, total in zip(names, sums.tolist(), strict=True)
    ]
