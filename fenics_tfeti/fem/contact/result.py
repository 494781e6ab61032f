"""Contact forces, gaps and slips of a solution at the slave nodes."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.parallel import concatenate_ranks
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class FrictionResult:
    """Friction at the nodes of a `ContactResult`.

    Attributes
    ----------
    force : (k, gdim) array
        Friction force on the slave, in the units of the normal force [N].
    traction : (k, gdim) array
        The force over the area that belongs to the node [Pa].
    bound : (k,) array
        Slip bound: the force at which the node slips [N].
    slip : (k, gdim) array
        Tangential displacement of the slave relative to the master or obstacle since the last
        solve, in the direction opposite to the force [m]; zero where it sticks.
    sticking : (k,) bool array
        Whether the force is below its bound.
    work : (k,) array
        Work that friction dissipates since the last solve: force times slip [J].
    """

    force: Vector
    traction: Vector
    bound: Vector
    slip: Vector
    sticking: NDArray[np.bool_]
    work: Vector

    @property
    def state(self) -> Numbers:
        """1 where a node sticks, 2 where it slips, 0 where friction has no force, (k,)."""
        slipping = ~self.sticking & (self.bound > 0.0) & self.force.any(axis=1)
        states: Numbers = self.sticking + 2 * slipping.astype(np.int64)
        return states


@dataclass(frozen=True)
class ContactResult:
    """The solution at the slave nodes that this rank owns.

    Attributes
    ----------
    name : str
        Name of the contact.
    nodes : (k,) integer array
        Global nodes of the displacement's space.
    coordinates : (k, 3) array
        [m].
    gap : (k,) array
        Gap in the undeformed state [m]; infinite where there is no obstacle. With mortar conditions
        the mean around the node.
    opening : (k,) array
        Gap after the solve [m]: zero where the contact is closed, infinite where there is no
        obstacle. It is the gap less the approach along the normal, with exact non-penetration of
        the surfaces of the last pass.
    normal : (k, gdim) array
        Outward unit normals of the slave.
    normal_force : (k,) array
        [N]; [N/m] in plane problems; in axisymmetric ones [N] if the forms have the factor
        2 pi r, [N/rad] if they have r.
    pressure : (k,) array
        Normal force over the area that belongs to the node, which has the problem's
        `measure_weight` [Pa].
    active : (k,) bool array
        Whether the normal force is positive.
    area : (k,) array
        The area by which the normal force is divided [m^2; m in 2D]. With mortar conditions that of
        the covered part of the surface around the node: the areas add up to what is covered, and
        the sum of ``pressure * area`` is the contact force.
    coverage : (k,) array
        The share of the slave's area around the node that the master covers, up to 1: less at the
        rim of the contact. With mortar conditions, nodes that are covered by less than 0.4 have no
        condition of their own, and are not among the nodes: what is covered around them belongs to
        their neighbours that are covered better, and has the mean of these' pressures.
    friction : FrictionResult or None
        Friction forces and slips; None for a contact without friction.
    on_master : bool
        Whether the nodes are those of the master, because ``roles="auto"`` has exchanged slave and
        master. Normals, forces and slips are those of the slave there.
    comm : MPI.Intracomm
        The ranks.
    """

    name: str
    nodes: Numbers
    coordinates: Vector
    gap: Vector
    opening: Vector
    normal: Vector
    normal_force: Vector
    pressure: Vector
    active: NDArray[np.bool_]
    area: Vector
    coverage: Vector
    friction: FrictionResult | None = None
    on_master: bool = False
    comm: MPI.Intracomm = field(default_factory=lambda: MPI.COMM_SELF, repr=False)

    def seen_from_master(self) -> ContactResult:
        """Return the result with all directions as on the other surface."""
        friction = self.friction
        if friction is not None:
            friction = replace(
                friction, force=-friction.force, traction=-friction.traction, slip=-friction.slip
            )
        return replace(self, normal=-self.normal, friction=friction, on_master=not self.on_master)

    def gather(self) -> ContactResult:
        """Return the nodes of all ranks, by node number, on every rank. Collective."""
        order = np.argsort(concatenate_ranks(self.comm, self.nodes))
        arrays = _gathered(self, self.comm, order)
        if self.friction is not None:
            friction = _gathered(self.friction, self.comm, order)
            arrays["friction"] = replace(self.friction, **friction)
        return replace(self, comm=MPI.COMM_SELF, **arrays)


def _gathered(
    result: ContactResult | FrictionResult, comm: MPI.Intracomm, order: Numbers
) -> dict[str, Any]:
    """Return the arrays of all ranks, in an order. Collective."""
    arrays = {f.name: getattr(result, f.name) for f in fields(result)}
    return {
        name: concatenate_ranks(comm, array)[order]
        for name, array in arrays.items()
        if isinstance(array, np.ndarray)
    }
