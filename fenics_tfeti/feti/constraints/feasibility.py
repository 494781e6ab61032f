"""Contact and tied conditions that contradict each other although no two of them are parallel.

Elastic bodies can fulfil any conditions whose rows are linearly independent. Rows that share nodes
may depend on each other: three walls around one node, say. By Farkas' lemma such conditions have no
common solution if there are forces lambda with lambda_I >= o, B'lambda = o and c'lambda < 0.
"""

from __future__ import annotations

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import FAR, PARALLEL, SAME_VALUE
from fenics_tfeti.parallel import concatenate_ranks
from fenics_tfeti.qp import bounded_springs
from fenics_tfeti.typing import Numbers, Vector


def check_conditions(system: TornSystem, constraints: Constraints, c: Vector) -> None:
    """Check that all conditions and the prescribed displacements have a common solution.

    Raises an InputError on all ranks that names the contacts and the slave nodes.
    """
    coupling = constraints.coupling
    if not coupling.groups:
        return
    (gaps,) = coupling.gather(c)
    own_rows = constraints.contacts.own_rows
    soft = (np.asarray(system.contacts.compliance)[:, 0] > 0.0) & (own_rows >= 0)
    soft_rows = concatenate_ranks(system.comm, constraints.layout.numbers[own_rows[soft]])
    # neither friction nor rows that give way demand anything of displacements
    demanding = ~coupling.tangential & ~np.isin(coupling.numbers, soft_rows)
    for group in coupling.groups:
        members = group[demanding[group]]
        # a tied row is two conditions
        tied = np.flatnonzero(coupling.tied[members])
        both = np.append(np.arange(members.size), tied)
        sign = np.append(np.ones(members.size), -np.ones(tied.size))
        W = coupling.whole_gram(members)[np.ix_(both, both)]
        rounding = coupling.tolerance[members[both]]
        found = contradiction(sign[:, None] * W * sign, sign * gaps[members[both]], rounding)
        if found.size:
            _raise(system, constraints, coupling.numbers[members[np.unique(both[found])]])


def contradiction(W: Vector, gaps: Vector, rounding: Vector | float = 0.0) -> Numbers:
    """Return rows of B_I u <= c that have no common solution; none if all of them have one.

    W (k, k) is the Gram matrix of the rows, which have unit length, and `gaps` (k,) is c. A
    contradiction that `rounding`, the errors of c, may have caused is none.

    Examples
    --------
    The normals of three walls, and a triangle between them that vanishes or is turned inside out.

    >>> import numpy as np
    >>> W = np.array([[1.0, -0.5, -0.5], [-0.5, 1.0, -0.5], [-0.5, -0.5, 1.0]])
    >>> [contradiction(W, np.full(3, gap)).tolist() for gap in (0.1, 0.0, -0.1)]
    [[], [], [0, 1, 2]]
    """
    gaps = gaps + rounding
    # gaps that are so much larger than what others lack have no part in a contradiction, and the
    # other gaps would be lost in their rounding
    near = np.flatnonzero(gaps <= FAR * (-gaps).max(initial=0.0))
    W, gaps = W[near][:, near], gaps[near]
    # gaps that contradict each other by rounding only leave a single point
    gaps = gaps + SAME_VALUE * np.abs(gaps).max(initial=0.0)
    violation = float((-gaps).max(initial=0.0))
    if violation == 0.0:
        return near[:0]
    values, vectors = np.linalg.eigh(W)
    there = values > PARALLEL
    rows = np.sqrt(values[there]) * vectors[:, there]
    # the least violation of all rows: forces with sum of rows o and c'lambda < 0, or none
    z = bounded_springs(rows, gaps)
    forces = np.maximum(rows @ z - gaps, 0.0)
    if forces.max() <= SAME_VALUE * violation:
        return near[:0]
    return near[forces > SAME_VALUE * forces.max()]


def _raise(system: TornSystem, constraints: Constraints, numbers: Numbers) -> None:
    """Raise the error; rows are named by the ranks that gave them."""
    nodes, contact_numbers = [], []
    for rows, positions in (
        (system.contacts, constraints.contacts.own_rows),
        (system.tied, constraints.tied.own_rows),
    ):
        known = np.flatnonzero(positions >= 0)
        named = known[np.isin(constraints.layout.numbers[positions[known]], numbers)]
        nodes.append(rows.slave[named])
        contact_numbers.append(rows.contact[named])
    slaves = np.unique(concatenate_ranks(system.comm, np.concatenate(nodes)))
    contacts = np.unique(concatenate_ranks(system.comm, np.concatenate(contact_numbers)))
    names = [system.contact_name(i) for i in contacts]
    raise InputError(
        "contact or tied conditions and prescribed displacements contradict each other: "
        f"{numbers.size} conditions of {', '.join(names)} at the slave nodes "
        f"{slaves[:6].tolist()} (global numbers) leave no place for these nodes. Check gaps and "
        "normals, make more room, or take the nodes out of one of the contacts"
    )
