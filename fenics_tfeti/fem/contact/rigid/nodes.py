"""Nodes of the mesh that move with rigid bodies: conditions in terms of the bodies' corners.

The cells of a rigid body are in no subdomain. A rigid motion is an affine function of the place, so
that the term of a row at a node of the body is one at the corners of its frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace, locate_dofs_topological

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.conditions.contact_conditions import Terms
from fenics_tfeti.fem.contact.descriptions.rigid_body import RigidBody
from fenics_tfeti.fem.contact.rigid.frames import BodyFrame, RigidBodies
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.displacement import prescribed_components
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import Tag, find_tagged
from fenics_tfeti.feti.system import ContactRows, Prescribed
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class RigidNodes:
    """The nodes that this rank owns, and the rigid bodies of the mesh that some move with."""

    nodes: NodeMap
    x: Vector  # (owned, gdim): undeformed places [m]
    bodies: Sequence[RigidBody]  # the first of a problem's `RigidBodies`, on all ranks
    body: Numbers  # (owned,): number of each node's body; -1 of deformable ones

    @staticmethod
    def of(
        space: FunctionSpace, bodies: Bodies, rigid: Mapping[int, RigidBody], coordinates: Vector
    ) -> RigidNodes:
        """Find the nodes of rigid cells, and check that no other cells have them. Collective."""
        nodes, distinct = NodeMap(space), list(dict.fromkeys(rigid.values()))
        x = coordinates[: nodes.owned, : space.mesh.geometry.dim]
        if not rigid:
            return RigidNodes(nodes, x, [], np.full(nodes.owned, -1))
        assert bodies.tags is not None
        number = np.array(
            [distinct.index(rigid[tag]) if tag in rigid else -1 for tag in bodies.tags.tolist()]
        )
        of_cells = number[bodies.of_cell]
        body = nodes.reduced_over_cells(of_cells, np.maximum)
        shared = (body >= 0) & (nodes.reduced_over_cells(of_cells, np.minimum) < 0)
        if bad := first_wrong(nodes.comm, shared, x):
            raise InputError(
                f"{bad.number} nodes belong to a rigid body of the mesh and to a deformable one, "
                f"the first at {bad.place}: give each body nodes of its own "
                "(fenics_tfeti.io.split_interfaces), and hold them together by a TiedPair whose "
                "master is the rigid one"
            )
        return RigidNodes(nodes, x, distinct, body)

    def check_supports(self, prescribed: Prescribed) -> None:
        """Check that no Dirichlet condition is for a node of a rigid body. Collective."""
        if not self.bodies:
            return
        held = prescribed_components(self.nodes, prescribed)[: self.nodes.owned].any(axis=1)
        if bad := first_wrong(self.nodes.comm, held & (self.body >= 0), self.x):
            raise InputError(
                f"Dirichlet conditions are for {bad.number} nodes of rigid bodies, the first at "
                f"{bad.place}: prescribe translation and rotation of the RigidBody instead"
            )

    def places_of(self, body: RigidBody) -> Vector:
        """Return the undeformed places (k, gdim) of this rank's nodes of a body."""
        if body not in self.bodies:
            return self.x[:0]
        return self.x[self.body == list(self.bodies).index(body)]

    def numbers_at(self, nodes: Numbers) -> Numbers:
        """Return the numbers of the bodies of nodes (k,), -1 of other nodes. Collective."""
        numbers = np.full(nodes.size, -1)
        in_mesh = nodes < self.nodes.total
        numbers[in_mesh] = self.nodes.values_at(self.body, nodes[in_mesh])
        return numbers

    def master_of(self, rows: ContactRows | Terms, name: str) -> RigidBody | None:
        """Return the rigid body of the rows' master, if any; the slave is on none. Collective."""
        if not self.bodies:
            return None
        number = self.numbers_at(rows.nodes)
        found = np.zeros((2, len(self.bodies) + 1), dtype=bool)
        found[rows.on_slave.astype(int), number] = True
        self.nodes.comm.Allreduce(MPI.IN_PLACE, found, MPI.LOR)
        names = [f"rigid body '{body.name or k}'" for k, body in enumerate(self.bodies)]
        slaves, masters = ([*np.flatnonzero(row[:-1])] for row in found[::-1])
        if slaves:
            raise InputError(
                f"{name}: the slave is on {names[slaves[0]]}; a deformable surface is expected. "
                "Exchange slave and master; forces between two rigid bodies are not unique: leave "
                "one of them deformable"
            )
        if len(masters) > 1 or (masters and found[0, -1]):
            raise InputError(
                f"{name}: the master is on {names[masters[0]]} and on another body: give the "
                "surfaces of each body a tag, and a contact, of their own"
            )
        return self.bodies[masters[0]] if masters else None

    def on_surface(self, facet_tags: Any, tag: Tag) -> bool:
        """Tell whether nodes of facets with a tag are on a rigid body. Collective."""
        space = self.nodes.space
        dim = space.mesh.topology.dim - 1
        # wrong tags are found later
        is_right = _compat.tags_are_on(facet_tags, space.mesh) and facet_tags.dim == dim
        if not (self.bodies and is_right):
            return False
        local = np.asarray(locate_dofs_topological(space, dim, find_tagged(facet_tags, tag)))
        number = self.nodes.values_at(self.body, self.nodes.to_global(local))
        return any_rank(self.nodes.comm, number >= 0)

    def joined(self, rows: ContactRows, bodies: RigidBodies) -> ContactRows:
        """Return rows in terms of the bodies' corners, with their prescribed motion. Collective."""
        if not self.bodies:
            return rows
        number = self.numbers_at(rows.nodes)
        on = number >= 0
        places, shift = self._state(bodies)
        nodal = self.nodes.values_at(np.hstack([places, shift]), rows.nodes[on])
        places, shift = np.split(nodal, 2, axis=1)
        columns = (rows.row[on], places, rows.coefficients[on], shift)
        offsets = np.append(0, np.cumsum(np.bincount(rows.row[~on], minlength=rows.size)))
        nodes, coefficients = rows.nodes[~on], rows.coefficients[~on]
        joined = replace(rows, offsets=offsets, nodes=nodes, coefficients=coefficients)
        for k, frame in enumerate(bodies.frames[: len(self.bodies)]):
            joined = frame.joined(joined, *(column[number[on] == k] for column in columns))
        return joined

    def relative_to_unknowns(self, displacement: Vector, bodies: RigidBodies) -> Vector:
        """Return a displacement (n,) less what is not among the unknowns at rigid nodes."""
        if not self.bodies:
            return displacement
        shift = self._state(bodies)[1]
        if bodies.from_here:
            shift = np.zeros_like(self.x)
            for frame, on in self._frames(bodies):
                at = frame.turned_places(self.x[on])
                shift[on] = frame.displacements(frame.motion_outside_unknowns(True), at)
        return displacement - shift.ravel()

    def fill(self, uh: Function, bodies: RigidBodies, is_small: bool) -> Function:
        """Fill a displacement at the bodies' nodes, of small rotations or any; ghosts too."""
        if not self.bodies:
            return uh
        values = self.nodes.values(uh)
        for frame, on in self._frames(bodies):
            x, translation = self.x[on], frame.motion[: self.nodes.components]
            values[on] = (
                frame.displacements(frame.motion, x)
                if is_small
                else frame.turned_places(x) + translation - x
            )
        uh.x.scatter_forward()
        return uh

    def resultants(self, force: Vector, bodies: RigidBodies) -> Vector:
        """Return forces and moments (bodies, modes) on the bodies of nodal forces. Collective."""
        modes = self.bodies[0].modes if self.bodies else 0
        sums = np.zeros((len(self.bodies), modes))
        for total, (frame, on) in zip(sums, self._frames(bodies), strict=True):
            at = frame.turned_places(self.x[on])
            for mode, unit in enumerate(np.identity(modes)):
                total[mode] = np.sum(force[on] * frame.displacements(unit, at))
        self.nodes.comm.Allreduce(MPI.IN_PLACE, sums)
        return sums

    def _frames(self, bodies: RigidBodies) -> list[tuple[BodyFrame, Numbers]]:
        """Return the frame of each body with its nodes of this rank."""
        frames = bodies.frames[: len(self.bodies)]
        return [(frame, np.flatnonzero(self.body == k)) for k, frame in enumerate(frames)]

    def _state(self, bodies: RigidBodies) -> tuple[Vector, Vector]:
        """Return where nodes are, less translations, and displacements that are no unknowns.

        With small rotations about the present place, u = shift + motion of the free components
        there.
        """
        places, shift = self.x.copy(), np.zeros_like(self.x)
        for frame, on in self._frames(bodies):
            at = places[on] = frame.turned_places(self.x[on])
            now = at + frame.motion[: self.nodes.components] - self.x[on]
            given = frame.body.prescribed_motion
            shift[on] = now + frame.displacements(given - frame.motion, at)
        return places, shift
