"""What holds of any solution: equilibrium, contact, friction, balance of rigid bodies.

Stresses are assembled by dolfinx, term by term; gaps and motions are those of the obstacles.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray
from posed import Posed

import ufl
from dolfinx import fem
from dolfinx.fem import petsc

from fenics_tfeti import Coulomb, RigidObstacle

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# accuracy of forces and gaps; solves are asked for 1e-8
ALLOWED = 1e-5


class Laws:
    """The laws on the nodes that this rank owns; `ratios` has how far they are from being kept.

    In units of the frame. A ratio above 1 breaks the law.
    """

    def __init__(self, posed: Posed, allowed: float = ALLOWED) -> None:
        self.posed, self.problem, self.allowed = posed, posed.solved, allowed
        self.comm, self.gdim, self.owned = posed.mesh.comm, posed.gdim, posed.owned
        self.x = posed.V.tabulate_dof_coordinates()[: self.owned]
        self.u = posed.now.x.array.reshape(-1, self.gdim)[: self.owned]
        self.results = list(self.problem.results)
        self.forces = [self._on_nodes(result) for result in self.results]
        self.bodies = list(posed.rigid.values()) + [
            c.rigid_body
            for c in self.problem.contacts
            if getattr(c, "rigid_body", None) is not None
        ]
        self.bodies = list({id(body): body for body in self.bodies}.values())
        self.motion = dict(zip(map(id, self.bodies), self.problem.rigid_bodies, strict=True))
        loads = [np.abs(body.load[: self.gdim]).max() for body in self.bodies]
        self.residual = self._residual()
        every = [self.residual, *self.forces, np.array(loads)]
        moved = [np.abs(m.translation).max(initial=0.0) for m in self.motion.values()]
        self.length = max(posed.largest(self.u), *moved, 0.0)
        self.extent = posed.largest(posed.places.max(axis=1) - posed.places.min(axis=1))
        self.extent *= posed.frame.metre
        # motions of this length make rounding errors of this size
        stiffness = posed.largest(posed.young.x.array) * self.extent ** (self.gdim - 2)
        floor = 1e-7 * stiffness * self.length
        self.force = max(floor, *(posed.largest(values) for values in every))

    def ratios(self) -> dict[str, float]:
        """Return all ratios. Collective."""
        found = {"equilibrium": self._out_of_balance()}
        found["converged"] = 0.0 if self.problem.report.converged else np.inf
        for k, contact in enumerate(self.problem.contacts):
            if not hasattr(self.results[k], "nodal_normal_force"):
                continue
            of_contact = self._signs(self.results[k])
            if isinstance(contact, RigidObstacle) and self.posed.degree == 1:
                of_contact |= self._obstacle(k, contact)
            if contact.friction is not None:
                of_contact |= self._friction(k, contact)
            for name, value in of_contact.items():
                found[name] = max(found.get(name, 0.0), value)
        for body in self.bodies:
            found["rigid body"] = max(found.get("rigid body", 0.0), self._body(body))
        return found

    # -- forces at nodes ---------------------------------------------------------------------------

    def _on_nodes(self, result: Any) -> Vector:
        """Return the forces on the nodes of a result (owned, gdim)."""
        force = np.zeros((self.owned, self.gdim))
        if hasattr(result, "nodal_force"):
            of_nodes = result.nodal_force
        else:
            of_nodes = -result.nodal_normal_force[:, None] * result.normal
            if result.friction is not None:
                of_nodes = of_nodes + result.friction.force
            if result.on_master:
                of_nodes = -of_nodes
        np.add.at(force, result.dofs, of_nodes)
        return force

    def _residual(self) -> Vector:
        """Return what the stresses exert on nodes less the loads, each term compiled apart."""
        posed = self.posed
        terms = [ufl.action(t, posed.now) for t in posed.terms]
        if posed.method == "finite":
            terms = list(posed.terms)
        if posed.L:
            terms.append(-posed.L)
        whole = np.zeros((self.owned, self.gdim))
        for term in terms:
            vector = petsc.assemble_vector(fem.form(term))
            vector.ghostUpdate(PETSc.InsertMode.ADD_VALUES, PETSc.ScatterMode.REVERSE)
            whole += vector.array_r.reshape(-1, self.gdim)[: self.owned]
            vector.destroy()
        return whole

    def _out_of_balance(self) -> float:
        """Return the largest force at nodes, or of groups of bodies, that nothing balances.

        The forces of pairs at single nodes of the master are not known, only their sums, and
        neither are those of conditions of degree 2 on obstacles. Such nodes are in the groups of
        bodies that a pair joins.
        """
        fixed = np.zeros((self.owned, self.gdim), dtype=bool)
        for bc in self.posed.bcs:
            dofs, _ = bc.dof_indices()
            fixed.ravel()[dofs[dofs < fixed.size]] = True
        body = self.posed.bodies_of_nodes()
        rest = self.residual.copy()
        # by number of the body, what surfaces of pairs get from the contact
        sums = np.zeros((int(self.posed.cell_tags.values.max(initial=0)) + 2, self.gdim))
        sums = np.zeros((self.comm.allreduce(len(sums), MPI.MAX), self.gdim))
        group = np.arange(len(sums))
        is_pair = np.zeros(self.owned, dtype=bool)
        for contact, result, force in zip(
            self.problem.contacts, self.results, self.forces, strict=True
        ):
            of_obstacle = isinstance(contact, RigidObstacle)
            if of_obstacle and self.posed.degree == 1:
                rest -= force
                continue
            surfaces = [(contact.slave, result.entry.force)]
            if not of_obstacle:
                surfaces.append((contact.master, result.entry.force_on_master))
            for tag, total in surfaces:
                side = self.posed.nodes_on(tag)
                is_pair |= side
                there = np.unique(np.concatenate(self.comm.allgather(body[side])))
                group[np.isin(group, group[there])] = group[there].min()
                sums[there[0]] += np.asarray(total)
        rest[fixed | np.isin(body, list(self.posed.rigid))[:, None]] = 0.0
        off = self.posed.largest(rest[~is_pair])
        totals = np.zeros_like(sums)
        np.add.at(totals, body, rest)
        totals = self.comm.allreduce(totals) - sums
        supported = self.comm.allreduce((fixed.any(axis=1) & is_pair).astype(int).sum()) > 0
        for g in np.unique(group):
            rigid = np.isin(np.flatnonzero(group == g), list(self.posed.rigid)).any()
            if not (supported or rigid):
                off = max(off, float(np.abs(totals[group == g].sum(axis=0)).max()))
        return off / (self.allowed * self.force or 1.0)

    # -- contacts ----------------------------------------------------------------------------------

    def _signs(self, result: Any) -> dict[str, float]:
        """Compare the forces and openings of a result with the conditions of contact."""
        largest, force = self.posed.largest, result.nodal_normal_force
        opening = np.where(np.isfinite(result.opening), result.opening, 0.0)
        pressed = force > self.allowed * self.force
        scale = self.allowed * self.length or 1.0
        return {
            "tension": largest(np.minimum(force, 0.0)) / (self.allowed * self.force or 1.0),
            "opening": largest(np.minimum(opening, 0.0)) / scale,
            "complementarity": largest(opening[pressed]) / scale,
        }

    def _obstacle(self, k: int, contact: Any) -> dict[str, float]:
        """Measure gaps at all nodes of the surface, whether the package has rows there or not."""
        there = np.flatnonzero(self.posed.nodes_on(contact.slave))
        x, u = self.x[there], self.u[there]
        gap, normal = (np.asarray(part) for part in contact.obstacle(x.T))
        normal = np.asarray(normal)[: self.gdim].T
        if self.posed.method == "linear":
            moved = u - self.motion_of(contact.rigid_body, x[:, : self.gdim])
            gap = gap + np.einsum("ka,ka->k", normal, moved)
        else:
            places = x.copy()
            places[:, : self.gdim] = self.before(contact.rigid_body, x[:, : self.gdim] + u)
            gap = np.asarray(contact.obstacle(places.T)[0])
        finite = np.isfinite(gap)
        force = np.zeros(self.owned)
        force[self.results[k].dofs] = self.results[k].nodal_normal_force
        force = force[there]
        scale = self.allowed * max(self.length, 1e-6 * self.extent)
        pressed = finite & (force > 1e-4 * self.force)
        return {
            "penetration": self.posed.largest(np.minimum(gap[finite], 0.0)) / scale,
            "pressed and open": self.posed.largest(gap[pressed]) / scale,
        }

    def motion_of(self, body: Any, x: Vector) -> Vector:
        """Return the displacement (k, gdim) of points of an obstacle by a small motion."""
        if body is None:
            return np.zeros_like(x)
        result, arm = self.motion[id(body)], x - body.point
        if self.gdim == 2:
            turned = result.rotation[0] * np.column_stack([-arm[:, 1], arm[:, 0]])
        else:
            turned = np.cross(result.rotation, arm)
        moved: Vector = turned + np.asarray(result.translation)
        return moved

    def before(self, body: Any, places: Vector) -> Vector:
        """Return where points of an obstacle that are at places now were before its motion."""
        if body is None:
            return places
        result = self.motion[id(body)]
        R = rotation(np.asarray(result.rotation))
        before: Vector = (places - body.point - result.translation) @ R + body.point
        return before

    def _friction(self, k: int, contact: Any) -> dict[str, float]:
        """Compare friction with its law, and at obstacles at rest with the motion of nodes."""
        result, largest = self.results[k], self.posed.largest
        friction = result.friction
        size, scale = np.linalg.norm(friction.force, axis=1), self.allowed * self.force or 1.0
        bound = friction.bound
        if isinstance(contact.friction, Coulomb) and np.isscalar(contact.friction.coefficient):
            bound = contact.friction.coefficient * result.nodal_normal_force
        slips = (friction.state == 2) & (bound > scale)
        found = {
            "cone": largest(np.maximum(size - bound, 0.0)) / scale,
            "slipping below its bound": largest((bound - size)[slips]) / scale,
        }
        at_rest = isinstance(contact, RigidObstacle) and contact.displacement is None
        if (
            at_rest
            and contact.rigid_body is None
            and self.posed.method == "linear"
            and self.posed.is_first
        ):
            u = self.u[result.dofs]
            along = u - np.einsum("ka,ka->k", u, result.normal)[:, None] * result.normal
            work = np.einsum("ka,ka->k", along, friction.force)
            against = work + size * np.linalg.norm(along, axis=1)
            holds = size < bound - 10.0 * scale
            length = self.allowed * self.length or 1.0
            found["slip where it sticks"] = largest(along[holds]) / length
            found["direction of friction"] = largest(against) / (length * self.force or 1.0)
        return found

    # -- rigid bodies ------------------------------------------------------------------------------

    def _body(self, body: Any) -> float:
        """Return what nothing balances of the forces and moments on a rigid body."""
        result = self.motion[id(body)]
        tags = [tag for tag, rigid in self.posed.rigid.items() if rigid is body]
        own = self.posed.bodies_of_nodes()
        force, moment = np.zeros(self.gdim), np.zeros(body.modes - self.gdim)
        size = 0.0
        for contact, of_nodes in zip(self.problem.contacts, self.forces, strict=True):
            if isinstance(contact, RigidObstacle):
                acts = contact.rigid_body is body
            else:
                masters = np.concatenate(
                    self.comm.allgather(own[self.posed.nodes_on(contact.master)])
                )
                acts = bool(tags) and np.isin(masters, tags).any()
            if not acts:
                continue
            places = self.x[:, : self.gdim] - body.point
            if self.posed.method != "linear":
                places = places + self.u - np.asarray(result.translation)
            elif isinstance(contact, RigidObstacle):
                # forces act on the obstacle's surface, which is a gap away
                gap, normal = (np.asarray(part) for part in contact.obstacle(self.x.T))
                away = np.where(np.isfinite(gap), gap, 0.0) * normal[: self.gdim]
                places = places - away.T
            size += float(np.linalg.norm(of_nodes, axis=1).sum())
            force -= of_nodes.sum(axis=0)
            moment -= (
                np.cross(places, of_nodes).sum(axis=0)
                if self.gdim == 3
                else np.sum(places[:, 0] * of_nodes[:, 1] - places[:, 1] * of_nodes[:, 0])
            )
        total = self.comm.allreduce(np.append(force, moment)) + body.load
        motion = np.append(result.translation, result.rotation)
        total = total - body.stiffness @ motion
        size = self.comm.allreduce(size) + float(np.linalg.norm(body.load[: self.gdim]))
        # of a body that nothing touches there is rounding alone, and one that touches without force
        # is displaced by errors, which the solution's accuracy limits, times what holds it
        held = np.abs(body.stiffness[: self.gdim, : self.gdim]).max(initial=0.0) * self.length
        floor = max(1e-6 * self.force, self.posed.rtol * held / self.allowed)
        # passes and Newton's method end with what is left relative to the forces of all bodies,
        # moments as forces at the corners of a simplex around the contact, gdim times as wide
        if self.posed.method != "linear":
            every = sum(float(np.linalg.norm(part, axis=1).sum()) for part in self.forces)
            floor = max(floor, self.posed.balance * self.comm.allreduce(every) / self.allowed)
        scale = np.full(body.modes, max(size, floor))
        scale[self.gdim :] = self.extent * max(size, self.gdim * floor)
        free = body.is_free
        return float(np.abs(total / (self.allowed * scale + 1e-300))[free].max(initial=0.0))


def rotation(angles: Vector) -> Vector:
    """Return the matrix of a rotation by axis times angle, in the plane by the angle."""
    if angles.size == 1:
        c, s = np.cos(angles[0]), np.sin(angles[0])
        return np.array([[c, -s], [s, c]])
    from scipy.spatial.transform import Rotation

    matrix: Vector = Rotation.from_rotvec(angles).as_matrix()
    return matrix
