"""Small contact problems with everything that derivatives may be by, and Taylor tests of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scenes import (
    CLAMPED,
    GROUND,
    LOADED,
    MASTER,
    SIDE_X,
    SLAVE,
    Scene,
    at,
    axisymmetric_strain,
    dimension,
    scalar_space,
    strain,
    stress,
)

import ufl
from dolfinx import fem

from fenics_tfeti import (
    BoltPreload,
    ContactPair,
    ContactProblem,
    Deformed,
    PeriodicPair,
    RigidBody,
    Sphere,
    TiedPair,
)
from fenics_tfeti.fem import _compat
from fenics_tfeti.sensitivities.forms import node_changes, places_space

# of the upper body's lower face, which touches near the middle
CROWN, GAP = 0.02, 1e-3
RTOL = 1e-12
OPTIONS = {"rtol": RTOL, "subdomain_size": 60}
EXACT = Deformed(tolerance=1e-11, max_passes=40)


@dataclass
class Sensitive:
    """A problem whose data may be changed, with a functional of its solution."""

    scene: Scene
    problem: ContactProblem
    E: fem.Function
    body_force: fem.Function
    traction: fem.Constant
    clamp: fem.Function
    J: ufl.Form
    contacts: list[Any]  # at first

    @property
    def joint(self) -> Any:
        """The first contact, as it was at first."""
        return self.contacts[0]

    def solve(self) -> Any:
        """Solve, and return the result of the first contact."""
        self.problem.solve()
        return self.problem.results[0]

    def value(self) -> float:
        """Solve, and return J with half of the squares of the normal forces."""
        force = self.solve().nodal_normal_force
        comm = self.scene.mesh.comm
        squares = comm.allreduce(0.5 * float(force @ force))
        return comm.allreduce(fem.assemble_scalar(fem.form(self.J))) + squares

    def adjoint(self) -> Any:
        """Return the adjoint of `value` at the last solution."""
        force = self.problem.results[0].nodal_normal_force
        return self.problem.adjoint(self.J, normal_forces={0: force}, rtol=RTOL)

    def change(self, tangent: Any) -> float:
        """Return what the value changes by along a tangent."""
        comm, force = self.scene.mesh.comm, self.problem.results[0].nodal_normal_force
        of_forces = comm.allreduce(float(force @ tangent.nodal_normal_force(0)))
        along = ufl.derivative(self.J, self.problem.u, tangent.u)
        return comm.allreduce(fem.assemble_scalar(fem.form(along))) + of_forces


def crown_gap(gdim: int) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the distance between the blocks as a function of x."""
    return lambda x: GAP + CROWN * 4 * np.sum((x[: gdim - 1] - 0.45) ** 2, axis=0)


def crowned(gdim: int) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the shape of two blocks, the upper one with a crown."""

    def shape(x: NDArray[np.float64]) -> NDArray[np.float64]:
        x, up = np.array(x), gdim - 1
        # the upper block is drawn a little higher, so that its nodes are known
        height = x[up] - 0.01
        lift = crown_gap(gdim)(x) * (2.0 - height)
        x[up] = np.where(x[up] > 1.005, height + lift, x[up])
        return x

    return shape


def blocks(
    cell: str = "triangle",
    n: int = 5,
    m: int = 5,
    degree: int = 1,
    friction: Any = None,
    is_axisymmetric: bool = False,
    comm: MPI.Comm = MPI.COMM_WORLD,
    partners: Any = None,
    law: Any = None,
    **options: Any,
) -> Sensitive:
    """Two blocks of n and m cells along an edge: the upper one is moved down and aside."""
    gdim = dimension(cell)
    up, low, high, step = gdim - 1, np.zeros(gdim), np.ones(gdim), 1.01 * np.eye(gdim)[gdim - 1]
    scene = Scene.of_boxes(
        comm,
        cell,
        [(low, high, (n,) * gdim), (low + step, high + step, (m,) * gdim)],
        [
            (CLAMPED, at(up, 0.0), 1),
            (MASTER, at(up, 1.0), 1),
            (SLAVE, at(up, 1.01), 2),
            (LOADED, at(up, 2.01), 2),
            (SIDE_X, at(0, 1.0), 2),
        ],
        crowned(gdim),
        degree=degree,
    )
    how = {"friction": friction, "roles": "given", "partners": partners, "law": law}
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, name="joint", **how)
    return sensitive(scene, [pair], is_axisymmetric, friction is not None, **options)


def sensitive(
    scene: Scene,
    contacts: list[Any],
    is_axisymmetric: bool = False,
    moves_aside: bool = True,
    clamped: int = CLAMPED,
    down: float = 0.012,
    **arguments: Any,
) -> Sensitive:
    """Give a scene its forms: Young's modulus by cell, a body force, and a traction on a side.

    The top moves down, in its own right or as the clamped part.
    """
    mesh, V, gdim, up = scene.mesh, scene.V, scene.gdim, scene.gdim - 1
    E = fem.Function(scalar_space(mesh, "DG", 0), name="E")
    E.interpolate(lambda x: 1.0 + 0.3 * np.sin(3 * x[0]) * np.cos(2 * x[up]))
    force = fem.Function(V, name="b")
    force.interpolate(lambda x: np.stack([2e-3 * np.sin(x[0] + i) for i in range(gdim)]))
    traction = fem.Constant(mesh, np.array([*[2e-3] * up, -5e-3]))
    weight = ufl.SpatialCoordinate(mesh)[0] if is_axisymmetric else None
    of = axisymmetric_strain if is_axisymmetric else strain
    factor = fem.Constant(mesh, 1.0) if weight is None else weight
    a = factor * ufl.inner(stress(scene.u, E, strain=of), of(scene.v)) * ufl.dx
    L = factor * ufl.dot(force, scene.v) * ufl.dx
    L += factor * ufl.dot(traction, scene.v) * scene.ds(SIDE_X)
    clamp, top = fem.Function(V, name="clamp"), fem.Function(V, name="top")
    aside = 6e-3 if moves_aside else 0.0
    top.interpolate(lambda x: np.stack([*[0 * x[0] + aside] * up, 0 * x[0] - down]))
    if clamped == LOADED:
        clamp.interpolate(top)
    else:
        scene.fix(LOADED, value=top)
    scene.fix(clamped, value=clamp)
    problem = ContactProblem(
        a,
        L,
        bcs=scene.bcs,
        contacts=contacts,
        cell_tags=scene.cell_tags,
        options=OPTIONS,
        measure_weight=weight,
        **arguments,
    )
    u = problem.u
    J = factor * (u[0] ** 2 + 3 * u[up] ** 2 + u[0] * u[up]) * ufl.dx
    return Sensitive(scene, problem, E, force, traction, clamp, J, contacts)


# -- Taylor tests ----------------------------------------------------------------------------------


@dataclass
class Parameter:
    """A direction of the data: how to go along it, and its derivative."""

    set_value: Callable[[float], Any]
    slope: Callable[[Any], float]  # by the adjoint
    tangent: dict[str, Any] | None  # arguments
    step: float


def direction_of(function: fem.Function) -> fem.Function:
    """Return a Function with numbers of no pattern, whatever the ranks."""
    direction = fem.Function(function.function_space)
    if _compat.element_facts(function.function_space)[1] == 0:
        direction.interpolate(lambda x: np.sin(40 * x[0] + 23 * x[1] + 1))
    else:
        gdim = function.function_space.mesh.geometry.dim
        direction.interpolate(
            lambda x: np.stack([np.sin(9 * x.sum(axis=0) + i) for i in range(gdim)])
        )
    return direction


def of_function(m: fem.Function, step: float) -> Parameter:
    start, along = m.x.array.copy(), direction_of(m)

    def set_value(s: float) -> None:
        m.x.array[:] = start + s * along.x.array

    def slope(adjoint: Any) -> float:
        own = adjoint.by(m)
        return m.function_space.mesh.comm.allreduce(float(own @ along.x.array[: own.size]))

    return Parameter(set_value, slope, {"data": {m: along}}, step)


def of_constant(m: fem.Constant, step: float) -> Parameter:
    start, along = np.array(m.value), np.linspace(0.3, -1.0, m.value.size)

    def set_value(s: float) -> None:
        m.value[...] = start + s * along

    return Parameter(
        set_value, lambda adjoint: float(adjoint.by(m) @ along), {"data": {m: along}}, step
    )


def of_contact(sensitive: Sensitive, kind: str, step: float) -> Parameter:
    """Return a change of gap, of the law, or of friction of the first contact."""
    problem, contact = sensitive.problem, sensitive.joint
    comm = sensitive.scene.mesh.comm

    def changed(s: float) -> Any:
        if kind == "gap":
            gap = crown_gap(sensitive.scene.gdim)
            return replace(contact, initial_gap=lambda X: gap(X) + s * (1.0 + X[0]))
        field = "law" if kind == "law" else "friction"
        law, last = getattr(contact, field), kind == "elastic slip"
        # the bound or the coefficient comes first
        name, value = list(vars(law).items())[-1 if last else 0]
        law = replace(law, **{name: lambda X: value + s * (1.0 + X[0])})
        return replace(contact, **{field: law})

    def set_value(s: float) -> None:
        problem.contacts = [changed(s), *problem.contacts[1:]]

    set_value(0.0)
    result = sensitive.solve()
    along = 1.0 + result.coordinates[:, 0]
    if kind == "gap":
        # gaps of mortar conditions are means
        set_value(step)
        along = (sensitive.solve().gap - result.gap) / step
        along = np.where(np.isfinite(along), along, 0.0)
        set_value(0.0)
    by, to = {
        "gap": ("by_gap", "gaps"),
        "bound": ("by_slip_bound", "slip_bounds"),
        "coefficient": ("by_coefficient", "coefficients"),
        "law": ("by_law", None),
        "elastic slip": ("by_elastic_slip", None),
    }[kind]

    def slope(adjoint: Any) -> float:
        return comm.allreduce(float(getattr(adjoint, by)(0) @ along))

    return Parameter(set_value, slope, {to: {0: along}} if to else None, step)


def mesh_direction(sensitive: Sensitive) -> fem.Function:
    """Return a displacement of the nodes without a pattern, the same on any ranks."""
    mesh = sensitive.scene.mesh
    along = fem.Function(
        _compat.lagrange_space(mesh, _compat.geometry_degree(mesh), mesh.geometry.dim)
    )
    along.interpolate(
        lambda x: np.stack(
            [
                np.sin(1e3 * (i + 1) * x[0] + 2e3 * x[1] + 3e3 * x[2] + i)
                for i in range(mesh.geometry.dim)
            ]
        )
    )
    return along


def of_mesh(sensitive: Sensitive, step: float) -> Parameter:
    """Return a displacement of the nodes along which the kinds of conditions stay."""
    mesh, gdim = sensitive.scene.mesh, sensitive.scene.gdim
    along = fem.Function(places_space(mesh))
    up = gdim - 1
    along.interpolate(
        lambda x: np.stack(
            [
                *[0.2 * x[i] ** 2 for i in range(up)],
                0.05 * np.cos(3 * x[0]) * (x[up] > 1.0005) * x[up],
            ]
        )
    )
    start, moves = mesh.geometry.x.copy(), node_changes(along, mesh)

    def set_value(s: float) -> None:
        mesh.geometry.x[:] = start + s * moves

    return Parameter(set_value, lambda adjoint: adjoint.by_mesh(along), None, step)


def taylor(sensitive: Sensitive, parameter: Parameter, halvings: int = 2) -> tuple[Any, bool]:
    """Return the rates of the remainders of halved steps, and whether the sets stayed the same."""
    parameter.set_value(0.0)
    before = sensitive.value()
    start = _sets(sensitive)
    slope = parameter.slope(sensitive.adjoint())
    remainders, same = [], True
    for k in range(halvings + 1):
        s = parameter.step / 2**k
        parameter.set_value(s)
        remainders.append(abs(sensitive.value() - before - s * slope))
        same = same and _sets(sensitive) == start
    parameter.set_value(0.0)
    rates = np.log2(np.array(remainders[:-1]) / remainders[1:])
    print("rates", rates, "the same sets:", same)
    return rates, same


def _sets(sensitive: Sensitive) -> list[bytes]:
    sets = []
    for result in sensitive.problem.results:
        if hasattr(result, "active"):
            sets.append(result.active.tobytes())
            friction = result.friction
            sets += [] if friction is None else [friction.sticking.tobytes()]
    return sets


# -- other kinds of conditions ---------------------------------------------------------------------


def block_on_roller(
    friction: Any = None,
    cell: str = "triangle",
    body: RigidBody | None = None,
    comm: MPI.Comm = MPI.COMM_WORLD,
    law: Any = None,
    obstacle: Any = None,
    others: Callable[[Scene], list[Any]] = lambda scene: [],
    **arguments: Any,
) -> Sensitive:
    """Return a block pressed onto a rigid roller or ball, which is held or moves.

    There may be another obstacle in place of that, and other contacts.
    """
    gdim = dimension(cell)
    up, n = gdim - 1, 5 if gdim == 2 else 3
    marks = [(GROUND, at(up, 0.0)), (LOADED, at(up, 1.0)), (SIDE_X, at(0, 1.0))]
    box = (0.0,) * gdim, (1.0,) * gdim, (n,) * gdim
    scene = Scene.of_boxes(comm, cell, [box], marks)
    scene.cell_tags = None
    ball = obstacle or Sphere([*[0.45] * up, -2.0], 2.0)
    scene.add_obstacle(GROUND, ball, name="joint", friction=friction, rigid_body=body, law=law)
    scene.contacts += others(scene)
    moves_aside = friction is not None
    return sensitive(scene, scene.contacts, False, moves_aside, LOADED, **arguments)


def tied_stack(
    comm: MPI.Comm = MPI.COMM_WORLD, kind: type[Any] = TiedPair, upper: int = 3, **data: Any
) -> Sensitive:
    """Return two blocks, by default of other meshes, tied to each other and pressed on a roller."""
    scene = Scene.of_boxes(
        comm,
        "triangle",
        [((0, 0), (1, 1), (5, 5)), ((0, 1), (1, 2), (upper, upper))],
        [
            (GROUND, at(1, 0.0), 1),
            (MASTER, at(1, 1.0), 1),
            (SLAVE, at(1, 1.0), 2),
            (LOADED, at(1, 2.0), 2),
            (SIDE_X, at(0, 1.0), 2),
        ],
    )
    scene.add_obstacle(GROUND, Sphere([0.45, -2.0], 2.0), name="joint")
    scene.contacts.append(kind(scene.facet_tags, SLAVE, MASTER, name="tie", **data))
    return sensitive(scene, scene.contacts, moves_aside=False, clamped=LOADED)


def periodic_block(comm: MPI.Comm = MPI.COMM_WORLD) -> Sensitive:
    """Return a block pressed onto a roller, of whose sides the middle parts are a periodic pair."""

    def middle(side: float) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
        return lambda x: np.isclose(x[0], side) & (np.abs(x[1] - 0.5) < 0.31)

    marks = [
        (GROUND, at(1, 0.0)),
        (LOADED, at(1, 1.0)),
        (MASTER, middle(0.0)),
        (SLAVE, middle(1.0)),
    ]
    lower = lambda x: np.isclose(x[0], 1.0) & (x[1] < 0.21)  # noqa: E731
    box = (0.0, 0.0), (1.0, 1.0), (5, 5)
    scene = Scene.of_boxes(comm, "triangle", [box], [*marks, (SIDE_X, lower)])
    scene.cell_tags = None
    scene.add_obstacle(GROUND, Sphere([0.45, -2.0], 2.0), name="joint")
    sides = {"slave": SLAVE, "master": MASTER, "translation": (1.0, 0.0)}
    pair = PeriodicPair(scene.facet_tags, **sides, jump=(1e-3, -2e-3), name="tie")
    scene.contacts.append(pair)
    return sensitive(scene, scene.contacts, moves_aside=False, clamped=LOADED)


def of_tie(sensitive: Sensitive, step: float) -> Parameter:
    """Return a change of the preload of a bolt, or of the jump of a periodic pair."""
    problem, (joint, tie) = sensitive.problem, sensitive.contacts
    if isinstance(tie, BoltPreload):
        name = "shortening" if tie.force is None else "force"

        def changed(s: float) -> Any:
            return replace(tie, **{name: getattr(tie, name) + s})

        return _of_contacts(problem, [joint], changed, lambda adj: adj.by_preload("tie"), step)

    def with_jump(s: float) -> Any:
        jump = np.array(tie.jump)[:, None]
        return replace(tie, jump=lambda x: jump + s * np.stack([1.0 + x[1], x[1] ** 2]))

    def slope(adjoint: Any) -> float:
        y = problem.results["tie"].coordinates[:, 1]
        along = np.stack([1.0 + y, y**2], axis=1)
        return sensitive.scene.mesh.comm.allreduce(float(np.sum(adjoint.by_gap("tie") * along)))

    return _of_contacts(problem, [joint], with_jump, slope, step)


def of_motion(sensitive: Sensitive, step: float) -> Parameter:
    """Return a change of the prescribed motion of the roller."""
    contact, along = sensitive.joint, np.array([0.3, 1.0, 0.5])

    def changed(s: float) -> Any:
        body = contact.rigid_body
        motion = np.append(body.translation, body.rotation) + s * along
        return replace(
            contact, rigid_body=replace(body, translation=motion[:2], rotation=motion[2])
        )

    def slope(adjoint: Any) -> float:
        return float(adjoint.by_motion(0) @ along)

    return _of_contacts(sensitive.problem, [], changed, slope, step)


def _of_contacts(
    problem: ContactProblem,
    first: list[Any],
    changed: Callable[[float], Any],
    slope: Callable[[Any], float],
    step: float,
) -> Parameter:
    """Return a change of the contact after the first ones."""

    def set_value(s: float) -> None:
        problem.contacts = [*first, changed(s)]

    return Parameter(set_value, slope, None, step)
