"""A scene in a frame: turned, moved and in other units than those in which it is described."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.linalg as la
from numpy.random import Generator
from numpy.typing import NDArray
from scenes import Scene, strain

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Deformed, NonlinearContactProblem, RigidBody, Tresca
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.io import piecewise_constant

Vector = NDArray[np.float64]
Points = Callable[[Vector], Any]

# tags of facets; those of the surfaces are numbers from SURFACE on
BASE, LOADED, SURFACE = 1, 3, 10
# tolerance of passes over the geometry
EXACT = 1e-6
ACCURACY = {
    "linear": {"rtol": 1e-8},
    "exact": {"rtol": 1e-8},
    "finite": {"rtol": 1e-4, "newton_rtol": 1e-7},
}


@dataclass(frozen=True)
class Frame:
    """Where a scene is, and its units: x = metre (turn own + shift), stresses in `pascal`."""

    turn: Vector  # (gdim, gdim), a rotation
    shift: Vector  # (gdim,)
    metre: float = 1.0
    pascal: float = 1.0

    @staticmethod
    def draw(rng: Generator, gdim: int, along_axes: bool = False) -> Frame:
        """Draw a frame; along the axes, or also the one in which the scene is described."""
        if rng.random() < 0.4:
            return Frame(np.eye(gdim), np.zeros(gdim))
        turn = la.qr(rng.normal(size=(gdim, gdim)))[0]
        if along_axes:
            turn = np.diag(rng.choice([-1.0, 1.0], gdim))[rng.permutation(gdim)]
        turn[0] *= np.linalg.det(turn)
        units = 10.0 ** rng.uniform((-3, -3), (2, 11))
        return Frame(turn, rng.uniform(-3, 3, gdim), *units.tolist())

    @property
    def newton(self) -> float:
        """The unit of forces; in the plane per length."""
        return self.pascal * self.metre ** (self.shift.size - 1)

    def points(self, own: Vector) -> Vector:
        """Return places (gdim, n) from own ones."""
        placed: Vector = self.metre * (self.turn @ own + self.shift[:, None])
        return placed

    def own(self, x: Vector) -> Vector:
        """Return own places (gdim, n) from those in the frame (3, n)."""
        own: Vector = self.turn.T @ (x[: self.shift.size] / self.metre - self.shift[:, None])
        return own

    def body(self, reference: Sequence[float], **more: Any) -> RigidBody:
        """Return a rigid body; spring stiffnesses are those of all components of the motion."""
        gdim = self.shift.size
        of_turns = self.turn if gdim == 3 else np.eye(1)
        newton_metre = self.newton * self.metre
        given: dict[str, Any] = {"name": more.get("name", "")}
        if "force" in more:
            given["force"] = self.newton * self.turn @ more["force"]
        if "moment" in more:
            given["moment"] = newton_metre * more["moment"]
        if "translation" in more:
            given["translation"] = [
                None if value is None else self.metre * value
                for value in self._components(more["translation"])
            ]
        if "rotation" in more:
            given["rotation"] = more["rotation"]
            if gdim == 3 and more["rotation"] is not None and np.ndim(more["rotation"]):
                given["rotation"] = self._components(more["rotation"])
        if "spring" in more:
            units = np.repeat([self.newton / self.metre, newton_metre], [gdim, len(of_turns)])
            whole = la.block_diag(self.turn, of_turns)
            given["spring"] = whole @ np.diag(units * more["spring"]) @ whole.T
        point = self.points(np.reshape(np.asarray(reference, dtype=float), (gdim, 1)))[:, 0]
        return RigidBody(point, **given)

    def _components(self, values: Sequence[float | None]) -> list[float | None]:
        """Return components along the axes of the frame, some of which are free."""
        if all(value is not None for value in values):
            return list(self.turn @ np.array(values, dtype=float))
        turned = np.rint(self.turn).astype(int)
        assert np.allclose(turned, self.turn), "free components need a frame along the axes"
        axes = np.abs(turned).argmax(axis=1)
        signs = turned[np.arange(len(axes)), axes]
        return [
            None if values[k] is None else float(s * values[k])
            for k, s in zip(axes, signs, strict=True)
        ]

    def obstacle(self, own: Points) -> Points:
        """Return an obstacle: own places (gdim, n) -> gaps (n,), normals (gdim, n) or (gdim,)."""

        def gap_and_normal(x: Vector) -> tuple[Vector, Vector]:
            gap, normal = own(self.own(x))
            gdim = self.shift.size
            normal = np.broadcast_to(np.asarray(normal).reshape(gdim, -1), (gdim, x.shape[1]))
            return self.metre * gap, self.turn @ normal

        return gap_and_normal

    def vectors(self, own: Points, unit: float) -> Points:
        """Return a field of vectors at places, from one at own places."""
        return lambda x: unit * (self.turn @ own(self.own(x)))


@dataclass
class Answer:
    """What a solve found, in own coordinates: displacements, forces on slaves and pressures."""

    u: Vector  # (nodes that this rank owns, gdim)
    # (nodes,): numbers of these nodes in the input of the mesh; how a mesh is distributed may be
    # another thing each time that it is made
    nodes: NDArray[np.int64]
    forces: dict[str, Vector]  # (gdim,)
    pressures: dict[str, Vector] = field(default_factory=dict)  # (k,), by these numbers

    def only(self, chosen: NDArray[np.bool_]) -> Answer:
        """Leave out displacements of some nodes."""
        return replace(self, u=self.u[chosen], nodes=self.nodes[chosen])

    def on_all(self, comm: MPI.Comm) -> Vector:
        """Return the displacements on all ranks, by the numbers of the nodes. Collective."""
        nodes, u = (np.concatenate(comm.allgather(part)) for part in (self.nodes, self.u))
        return u[np.argsort(nodes)]


class Posed(Scene):
    """A scene that is put together in own coordinates and solved in a frame.

    `method` is "linear", "exact" (the same with exact non-penetration) or "finite".
    """

    def __init__(
        self,
        mesh: Any,
        facet_tags: Any,
        cell_tags: Any,
        frame: Frame,
        method: str,
        young: Sequence[float],
        poisson: float,
        degree: int = 1,
        two_rules: bool = False,
        weight: float | None = None,
    ) -> None:
        super().__init__(mesh, facet_tags, cell_tags, degree)
        self.frame, self.method, self.degree = frame, method, degree
        self.young = piecewise_constant(
            mesh, cell_tags, {k + 1: frame.pascal * E for k, E in enumerate(young)}
        )
        self.now = fem.Function(self.V)
        self.poisson = self.constant(poisson)
        # factor of all integrals, such as a thickness
        self.weight = None if weight is None else self.constant(weight)
        self.unknown = self.now if method == "finite" else self.u
        self.terms = self._elastic_terms(two_rules)
        self.rigid: dict[int, RigidBody] = {}
        self.solved: Any = None
        self.accuracy: dict[str, Any] = dict(ACCURACY[method])
        # whether the bodies were at rest before the present step
        self.is_first = True

    def _elastic_terms(self, two_rules: bool) -> list[Any]:
        """Return the forms of the stress: one, or those of shear and volume by different rules."""
        E, nu, w, v, g = self.young, self.poisson, self.unknown, self.v, self.gdim
        mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
        full = 2 * self.degree
        of_volume = ufl.dx(metadata={"quadrature_degree": 0 if two_rules else full})
        of_shear = ufl.dx(metadata={"quadrature_degree": 3 if two_rules else full})
        if self.method != "finite":
            shear = 2 * mu * ufl.inner(strain(w), strain(v))
            volume = lam * ufl.div(w) * ufl.div(v)
        else:
            F = ufl.Identity(g) + ufl.grad(w)
            J = ufl.det(F)
            energy, bulk = mu / 2 * (ufl.inner(F, F) - g) - mu * ufl.ln(J), lam
            if two_rules:
                # of which the shear term is isochoric
                size = ufl.inner(F, F) + (3 - g)
                energy, bulk = mu / 2 * (J ** (-2 / 3) * size - 3), lam + 2 / 3 * mu
            shear = ufl.derivative(energy, w, v)
            volume = ufl.derivative(bulk / 2 * ufl.ln(J) ** 2, w, v)
        if self.weight is not None:
            shear, volume = self.weight * shear, self.weight * volume
        if two_rules:
            return [shear * of_shear, volume * of_volume]
        return [(shear + volume) * of_shear]

    # -- supports, loads and contacts --------------------------------------------------------------

    def hold(self, tag: int, value: Any = 0.0) -> Callable[[Any], None]:
        """Prescribe displacements, own vectors or functions of own places; return their setter."""
        given = fem.Function(self.V)
        fdim = self.mesh.topology.dim - 1
        dofs = fem.locate_dofs_topological(self.V, fdim, self.facet_tags.find(tag))
        own = self.frame.own(self.V.tabulate_dof_coordinates()[dofs].T)

        def set_value(value: Any) -> None:
            values = value(own) if callable(value) else np.asarray(value, dtype=float)
            values = np.broadcast_to(
                values.reshape(-1, 1) if values.ndim < 2 else values, own.shape
            )
            turned = self.frame.metre * self.frame.turn @ values
            given.x.array.reshape(-1, self.gdim)[dofs] = turned.T

        set_value(np.zeros(self.gdim) if np.ndim(value) == 0 and not callable(value) else value)
        self.bcs.append(fem.dirichletbc(given, dofs))
        return set_value

    def guide(self, tag: int, axis: int) -> None:
        """Hold a component, in a frame along the axes."""
        component = int(np.abs(self.frame.turn[:, axis]).argmax())
        self.fix(tag, component)

    def push(self, traction: Any) -> Callable[[Any], None]:
        """Put a traction, an own vector, on LOADED; return its setter."""
        value = self.constant(np.zeros(self.gdim))

        def set_value(traction: Any) -> None:
            value.value[:] = self.frame.pascal * self.frame.turn @ np.asarray(traction, dtype=float)

        set_value(traction)
        self.L += ufl.inner(value, self.v) * self.ds(LOADED)
        return set_value

    def add_obstacle(self, slave: int, obstacle: Any, **more: Any) -> None:
        if "displacement" in more:
            more["displacement"] = self.frame.vectors(more["displacement"], self.frame.metre)
        super().add_obstacle(slave, self.frame.obstacle(obstacle), **self._in_units(more))

    def add_pair(self, slave: int = SURFACE, master: int = SURFACE + 1, **more: Any) -> None:
        super().add_pair(slave, master, **self._in_units(more))

    def _in_units(self, more: dict[str, Any]) -> dict[str, Any]:
        law = more.get("friction")
        if isinstance(law, Tresca):
            more["friction"] = Tresca(self.frame.pascal * law.slip_bound)
        return more

    # -- solutions ---------------------------------------------------------------------------------

    def make(self, **more: Any) -> Any:
        """Return the package's problem."""
        given = {"bcs": self.bcs, "contacts": self.contacts, "cell_tags": self.cell_tags}
        given |= {"options": self.accuracy, "rigid_bodies": self.rigid}
        given |= {"measure_weight": self.weight, **more}
        elastic = sum(self.terms[1:], self.terms[0])
        if self.method == "finite":
            residual = elastic - self.L if self.L else elastic
            self.solved = NonlinearContactProblem(residual, self.now, **given)
        else:
            exact = Deformed(EXACT) if self.method == "exact" else None
            self.solved = ContactProblem(elastic, self.L, u=self.now, **{"gaps": exact, **given})
        return self.solved

    def solve(self, **more: Any) -> Answer:
        """Solve, after `make` the problem that it has made."""
        problem = self.solved if self.solved is not None else self.make(**more)
        problem.solve()
        return self.answer()

    @property
    def rtol(self) -> float:
        """The tolerance of displacements."""
        return float(self.accuracy.get("newton_rtol", self.accuracy["rtol"]))

    @property
    def balance(self) -> float:
        """The part of all forces that may be left on a rigid body."""
        return EXACT if self.method == "exact" else self.rtol

    def advance(self) -> None:
        """Accept the step."""
        self.solved.advance()
        self.is_first = False

    @property
    def owned(self) -> int:
        """Number of nodes of this rank."""
        return int(self.V.dofmap.index_map.size_local)

    @property
    def places(self) -> Vector:
        """Own places (gdim, nodes) of the nodes, those of other ranks after this rank's."""
        return self.frame.own(self.V.tabulate_dof_coordinates().T)

    def nodes_on(self, *tags: int) -> NDArray[np.bool_]:
        """Tell which nodes of this rank are on facets with tags. Collective."""
        fdim = self.mesh.topology.dim - 1
        there = np.zeros(self.owned, dtype=bool)
        for tag in tags:
            dofs = fem.locate_dofs_topological(self.V, fdim, self.facet_tags.find(tag))
            there[dofs[dofs < self.owned]] = True
        return there

    def bodies_of_nodes(self) -> NDArray[np.int64]:
        """Return the tag of the cells of each node of this rank."""
        tag_of_node = np.zeros(self.owned, dtype=np.int64)
        for cell, tag in zip(self.cell_tags.indices, self.cell_tags.values, strict=True):
            dofs = self.V.dofmap.cell_dofs(int(cell))
            tag_of_node[dofs[dofs < self.owned]] = tag
        return tag_of_node

    def answer(self) -> Answer:
        """Return the last solution. Collective."""
        values = self.now.x.array.reshape(-1, self.gdim)[: self.owned]
        nodes = NodeMap(self.V)
        numbers, forces, pressures = nodes.input_numbers, {}, {}
        for result in self.solved.results:
            forces[result.name] = self.frame.turn.T @ result.force / self.frame.newton
            if hasattr(result, "pressure"):
                whole = result.gather()
                order = np.argsort(nodes.values_at(numbers, whole.nodes), kind="stable")
                pressures[result.name] = whole.pressure[order] / self.frame.pascal
        return Answer(values @ self.frame.turn / self.frame.metre, numbers, forces, pressures)

    def largest(self, values: Any) -> float:
        """Return the largest magnitude on all ranks."""
        mine = float(np.abs(np.asarray(values)).max(initial=0.0))
        return float(self.mesh.comm.allreduce(mine if mine == mine else np.inf, MPI.MAX))


def differ(posed: Posed, first: Answer, second: Answer, tolerance: float) -> dict[str, float]:
    """Return by how much two answers differ, relative to what is allowed. Collective."""
    # less than the rounding of coordinates is no motion
    size = max(posed.largest(first.u), posed.largest(second.u), 1e-10)
    first_u, second_u = (answer.on_all(posed.mesh.comm) for answer in (first, second))
    found = {"u": posed.largest(first_u - second_u) / (tolerance * size)}
    every = [*first.forces.values(), *second.forces.values()]
    largest = max([float(np.abs(f).max()) for f in every], default=0.0) + 1e-12
    for name in first.forces.keys() & second.forces.keys():
        off = float(np.abs(first.forces[name] - second.forces[name]).max())
        found[f"force of {name}"] = off / (tolerance * largest)
    return found
