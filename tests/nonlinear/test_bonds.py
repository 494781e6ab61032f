"""Bonds that break at finite strains: columns of uniform stress, turned blocks, a peeled strip."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from columns import FOOT, MASTER, SLAVE, TOP, YOUNG, columns
from scenes import at, plane
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import ufl
from dolfinx import fem

from fenics_tfeti import (
    Cohesive,
    ContactPair,
    ContactProblem,
    DamageNotFound,
    Deformed,
    ElasticLayer,
    InputError,
    NonlinearContactProblem,
    RigidBody,
    RigidObstacle,
    TiedPair,
)
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

# mm-N-MPa
STRENGTH, ENERGY, STIFFNESS = 50.0, 5.0, 2500.0
ELASTIC, FAILURE = STRENGTH / STIFFNESS, 2.0 * ENERGY / STRENGTH
OPTIONS = {"newton_rtol": 1e-9, "subdomain_size": 60, "damage_rtol": 1e-9}


def residual_of(scene, u):
    """Return the residual of a material of Saint-Venant and Kirchhoff without lateral strain."""
    F = ufl.Identity(scene.gdim) + ufl.grad(u)
    stress = F * (0.5 * scene.young * (F.T * F - ufl.Identity(scene.gdim)))
    return ufl.inner(stress, ufl.grad(scene.v)) * scene.dx


def bonded(cell="quadrilateral", upper=4, comm=MPI.COMM_SELF, options=None, **law):
    """Return bonded columns, and the values of the displacements that hold their ends."""
    scene = columns(cell, upper, comm)
    scene.bcs = []
    ends = [fem.Function(scene.V) for _ in range(2)]
    for tag, value in zip((FOOT, TOP), ends, strict=True):
        scene.fix(tag, value=value)
    data = {"strength": STRENGTH, "energy": ENERGY, "stiffness": STIFFNESS, **law}
    scene.add_pair(law=Cohesive(**data), name="bond")
    u = fem.Function(scene.V)
    problem = NonlinearContactProblem(
        residual_of(scene, u),
        u,
        bcs=scene.bcs,
        contacts=scene.contacts,
        options={**OPTIONS, **(options or {})},
    )
    return scene, problem, ends


def pull(value, displacement):
    value.x.array.reshape(-1, value.function_space.dofmap.index_map_bs)[:, -1] = displacement


def stretched(traction):
    """Return by how much a unit column is longer under a traction (of its undeformed area)."""
    return brentq(lambda d: 0.5 * YOUNG * ((1.0 + d) ** 2 - 1.0) * (1.0 + d) - traction, -0.3, 0.3)


def in_series(displacement, damage):
    """Return traction and damage of the bond between columns whose top has moved up."""

    def bond(opening):
        """Return the damage, of openings that grow."""
        length = np.clip(opening, ELASTIC, FAILURE)
        d = FAILURE * (length - ELASTIC) / (length * (FAILURE - ELASTIC))
        return max(damage, d)

    def lacking(opening):
        traction = (1.0 - bond(opening)) * STIFFNESS * opening
        return opening + 2.0 * stretched(traction) - displacement

    if displacement < 0.0:
        traction = brentq(lambda t: 2.0 * stretched(t) - displacement, -0.17 * YOUNG, 0.0)
        return traction, 0.0, damage
    opening = brentq(lacking, 0.0, displacement + 1e-12)
    return (1.0 - bond(opening)) * STIFFNESS * opening, opening, bond(opening)


@pytest.mark.parametrize(("cell", "upper"), [("quadrilateral", 4), ("triangle", 5)])
@pytest.mark.filterwarnings("ignore:.*inside the other body")
def test_columns(cell, upper):
    """Pulled along the whole law; unloaded, closed and reloaded on the way."""
    scene, problem, (_, top) = bonded(cell, upper)
    damage, spent = 0.0, 0.0
    for displacement in (0.08, 0.14, 0.07, -0.1, 0.18, 0.3):
        pull(top, displacement)
        problem.solve()
        bond = problem.results["bond"]
        traction, opening, damage = in_series(displacement, damage)
        np.testing.assert_allclose(bond.pressure, -traction, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(bond.opening, opening, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(bond.damage, damage, rtol=1e-6)
        spent += problem.report.damage.dissipated["bond"]
        assert len(problem.report.newton) <= 5
        problem.advance()
    assert damage == 1.0
    assert spent == pytest.approx(ENERGY, rel=1e-6)
    assert problem.report.damage.failed == {"bond": bond.damage.size}


def bilinear(size, share):
    """Return the damage at the largest length of a jump so far, in a mode."""
    strength = np.sqrt(STRENGTH**2 + share**1.7 * (60.0**2 - STRENGTH**2))
    energy = ENERGY + share**1.7 * (12.0 - ENERGY)
    elastic = strength / STIFFNESS
    failure = 2.0 * energy / (STIFFNESS * elastic)
    return np.clip(failure * (size - elastic) / (size * (failure - elastic)), 0.0, 1.0)


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize(
    ("cell", "upper"), [("quadrilateral", 4), ("triangle", 5), ("tetrahedron", 5)]
)
def test_mixed_modes_on_blocks_that_turn(cell, upper, tmp_path):
    """Jumps are those of the turned surfaces: by 150 degrees, in steps, and from a checkpoint."""
    folder = MPI.COMM_WORLD.bcast(str(tmp_path))
    damage = 0.0
    law = {"shear_strength": 60.0, "shear_energy": 12.0, "exponent": 1.7}
    options = {"newton_rtol": 1e-7, "damage_rtol": 1e-7}
    jumps = [(0.01, 0.005), (0.04, 0.03), (0.02, 0.09)]
    for step, (along, across) in enumerate(jumps):
        if step in (0, 2):
            scene, problem, ends = bonded(cell, upper, MPI.COMM_WORLD, options, **law)
            scene.young.value = 1e9
            if step:
                assert problem.restore(f"{folder}/state") == step
        axis = [0.0, 0.0, 1.0] if scene.gdim == 2 else [0.0, 0.8, 0.6]
        turn = Rotation.from_rotvec(np.deg2rad(50.0 * (step + 1)) * np.array(axis))
        turn = turn.as_matrix()[: scene.gdim, : scene.gdim]
        jump = np.zeros(scene.gdim)
        jump[0], jump[-1] = along, across
        x = scene.V.tabulate_dof_coordinates()[:, : scene.gdim]
        for value, part in zip(ends, (0.0, 1.0), strict=True):
            value.x.array.reshape(-1, scene.gdim)[:] = (x + part * jump) @ turn.T - x
        # bodies begin where they have turned to
        u = problem.u.x.array.reshape(-1, scene.gdim)
        u[:] = x @ turn.T - x
        is_upper = np.unique(
            np.concatenate(
                [scene.V.dofmap.cell_dofs(c) for c in scene.cell_tags.find(2)] or [[]]
            ).astype(int)
        )
        u[is_upper] += jump @ turn.T
        problem.solve()
        bond, size = problem.results["bond"], np.hypot(along, across)
        damage = max(damage, bilinear(size, (along / size) ** 2))
        np.testing.assert_allclose(bond.damage, damage, rtol=1e-3)
        # along the turned surface; areas are those that are covered after the slip
        force = -bond.normal * bond.nodal_normal_force[:, None] + bond.friction.force
        total = scene.mesh.comm.allreduce(force.sum(axis=0))
        np.testing.assert_allclose(
            total, -(1.0 - damage) * STIFFNESS * turn @ jump, rtol=2e-3, atol=0.02
        )
        problem.advance()
        problem.save(f"{folder}/state")


def test_small_loads_are_those_of_small_strains():
    """A bond over a part of the surface, lifted by little: the same damage and forces."""
    small = {"strength": lambda x: np.where(x[0] > 0.4, 5e-3, 0.0), "energy": 5e-8}
    scene, problem, (_, top) = bonded(stiffness=None, options={"damage_rtol": 1e-6}, **small)
    linear = ContactProblem(
        scene.a,
        0,
        bcs=scene.bcs,
        contacts=scene.contacts,
        options={"rtol": 1e-8, "damage_rtol": 1e-6},
    )
    for displacement in (5e-6, 1e-5, 1.5e-5):
        pull(top, displacement)
        for each in (problem, linear):
            each.solve()
            each.advance()
        one, other = problem.results["bond"], linear.results["bond"]
        np.testing.assert_allclose(one.damage, other.damage, rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(one.pressure, other.pressure, rtol=1e-3, atol=1e-6)
    assert one.damage[one.damage < 1.0].max() > 0.0


@pytest.mark.once
def test_strip_that_is_peeled_off():
    """By a lifted end that turns by 50 degrees: what is stored and dissipated is the work."""
    length, height, young = 10.0, 0.5, 1000.0
    strip = boxes(MPI.COMM_SELF, [Box((0, 0), (length, height), (20, 2))], "quadrilateral")
    V = displacement_space(strip.mesh)
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = ufl.Identity(2) + ufl.grad(u)
    strain = 0.5 * (F.T * F - ufl.Identity(2))
    energy = 0.5 * young * ufl.inner(strain, strain) * ufl.dx
    vertical = V.sub(1).collapse()[0]
    lift = fem.Function(vertical)
    end = fem.locate_dofs_geometrical(
        (V.sub(1), vertical), lambda x: np.isclose(x[0], 0.0) & np.isclose(x[1], height)
    )
    held = fem.locate_dofs_geometrical(V, at(0, length))
    tags = tag_facets(strip.mesh, [(1, at(1, 0.0))])
    problem = NonlinearContactProblem(
        ufl.derivative(energy, u, v),
        u,
        bcs=[fem.dirichletbc(lift, end, V.sub(1)), fem.dirichletbc(np.zeros(2), held, V)],
        contacts=RigidObstacle(tags, 1, plane(1, 2), law=Cohesive(1.0, 0.5), name="glue"),
        options={"preconditioner": "dirichlet"},
    )
    balance = []
    for height in (0.25, 0.5, 0.75, 1.0, 1.25):
        lift.x.array[:] = height
        problem.solve()
        glue = problem.results["glue"]
        held_by = -glue.nodal_normal_force * glue.opening
        held_by -= np.sum(glue.friction.force * glue.friction.slip, axis=1)
        stored = fem.assemble_scalar(fem.form(energy)) + 0.5 * held_by[glue.damage < 1.0].sum()
        spent, force = problem.report.damage.dissipated["glue"], problem.report.reactions[0].force
        balance.append((height, abs(force[1]), stored, spent))
        problem.advance()
    height, force, stored, spent = np.array(balance).T
    work = np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(height))
    assert stored[-1] - stored[0] + spent[1:].sum() == pytest.approx(work, rel=1e-2)
    assert problem.report.damage.failed["glue"] >= 2


def test_loads_that_bonds_do_not_carry():
    """An error that leaves displacement, results and damage as they were."""
    scene = columns("quadrilateral")
    traction = scene.add_load(TOP, (0.0, 0.5 * STRENGTH))
    scene.add_pair(law=Cohesive(STRENGTH, ENERGY, STIFFNESS), name="bond")
    u = fem.Function(scene.V)
    problem = NonlinearContactProblem(
        residual_of(scene, u) - scene.L,
        u,
        bcs=scene.bcs,
        contacts=scene.contacts,
        options=OPTIONS,
    )
    problem.solve()
    problem.advance()
    before = u.x.array.copy()
    traction.value = (0.0, 1.2 * STRENGTH)
    with pytest.raises(DamageNotFound, match="damage of bonds is not found at these loads"):
        problem.solve()
    np.testing.assert_array_equal(u.x.array, before)
    assert problem.results["bond"].damage.max() == 0.0


def test_what_knows_no_bonds_at_finite_strains():
    scene, problem, (_, top) = bonded()
    pull(top, 0.08)
    problem.solve()
    with pytest.raises(InputError, match="derivatives at finite strains know no Cohesive"):
        problem.tangent({top: np.ones(top.x.array.size)})
    with pytest.raises(InputError, match=r"mesh_error\(\) is of hard or soft contact"):
        problem.mesh_error()
    with pytest.raises(InputError, match=r"bond: follow\(\) knows no bonds that break"):
        next(problem.follow(lambda t: None, 0.0, length=0.1, steps=1))
    law = Cohesive(STRENGTH, ENERGY)
    tags = scene.facet_tags
    for contact in (
        TiedPair(tags, SLAVE, MASTER, law=law, name="glue"),
        ContactPair(tags, SLAVE, MASTER, law=ElasticLayer(1.0), name="glue"),
        RigidObstacle(
            tags, FOOT, plane(1, 2), law=law, rigid_body=RigidBody((0.0, 0.0)), name="glue"
        ),
    ):
        problem.contacts = [contact]
        with pytest.raises(InputError, match="glue: law=.* is for small strains"):
            problem.solve()
    with pytest.raises(InputError, match=r"but gaps=Deformed\(\) moves them"):
        scene.problem(gaps=Deformed())
