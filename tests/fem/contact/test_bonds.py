"""Bonds that break, in columns of uniform stress: closed forms of the bilinear law."""

from __future__ import annotations

import warnings

from mpi4py import MPI

import numpy as np
import pytest
from columns import MESHES, TOP, YOUNG, columns, pulled, shear, sheared

from dolfinx import fem

from fenics_tfeti import Cohesive, Coulomb, DamageNotFound, InputError, Tresca

# mm-N-MPa; the columns have the compliance 2 / E, a line from the strength to the failure 0.2 of it
STRENGTH, ENERGY, STIFFNESS = 5.0, 0.05, 2500.0
ELASTIC, FAILURE = STRENGTH / STIFFNESS, 2.0 * ENERGY / STRENGTH
OPTIONS = {"rtol": 1e-11, "subdomain_size": 60, "damage_rtol": 1e-10}


def bonded(cell="quadrilateral", upper=4, comm=MPI.COMM_SELF, **law):
    """Return bonded columns, and the displacement of their top."""
    scene = columns(cell, upper, comm)
    moved = pulled(scene, 0.0)
    data = {"strength": STRENGTH, "energy": ENERGY, "stiffness": STIFFNESS, **law}
    scene.add_pair(law=Cohesive(**data), name="bond")
    return scene, moved


def move(moved: fem.Function, displacement: float) -> None:
    gdim = moved.function_space.dofmap.index_map_bs
    moved.x.array.reshape(-1, gdim)[:, -1] = displacement


def softened(displacement: float) -> float:
    """Return the traction of the bond in series with the columns, on the falling line."""
    fall = STRENGTH / (FAILURE - ELASTIC)
    return fall * (FAILURE - displacement) / (1.0 - fall * 2.0 / YOUNG)


@MESHES
def test_traction_rises_and_falls(cell, upper):
    """On the rising line, on the falling line and after the failure, in steps."""
    scene, moved = bonded(cell, upper)
    problem = scene.problem(options=OPTIONS)
    for displacement in (0.008, 0.014, 0.018, 0.03):
        move(moved, displacement)
        problem.solve()
        bond = problem.results["bond"]
        if displacement == 0.008:
            traction = displacement / (2.0 / YOUNG + 1.0 / STIFFNESS)
        else:
            traction = max(softened(displacement), 0.0)
        opening = displacement - 2.0 * traction / YOUNG
        np.testing.assert_allclose(bond.pressure, -traction, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(bond.opening, opening, rtol=1e-7)
        np.testing.assert_allclose((1.0 - bond.damage) * STIFFNESS * opening, traction, atol=1e-7)
        problem.advance()
    assert problem.report.damage.failed == {"bond": bond.damage.size}
    assert not bond.active.any()


def test_unloading_closing_and_reloading():
    """Along a line to zero, then hard contact, and back along the line."""
    scene, moved = bonded()
    problem = scene.problem(options=OPTIONS)
    move(moved, 0.014)
    problem.solve()
    problem.advance()
    first = problem.results["bond"]
    for factor in (0.5, -0.7, 0.3, 1.0):
        move(moved, 0.014 * factor)
        problem.solve()
        bond = problem.results["bond"]
        assert problem.report.damage.passes == 1
        np.testing.assert_array_equal(bond.damage, first.damage)
        stress = factor * first.pressure if factor > 0.0 else -0.014 * factor * YOUNG / 2.0
        np.testing.assert_allclose(bond.pressure, stress, rtol=1e-9)
        assert bond.opening.min() > -1e-12
        problem.advance()


def test_energy_is_the_work_that_is_not_stored():
    """By increments, in several steps: the area that the loads have passed around."""
    scene, moved = bonded()
    problem = scene.problem(options=OPTIONS)
    spent, work, last = 0.0, 0.0, (0.0, 0.0)
    # both ends of the falling line are points of the polygon
    kink = STRENGTH * 2.0 / YOUNG + ELASTIC
    for displacement in (kink, 0.014, 0.016, FAILURE, 0.03):
        move(moved, displacement)
        problem.solve()
        force = -problem.results["bond"].nodal_normal_force.sum()
        spent += problem.report.damage.dissipated["bond"]
        work += 0.5 * (force + last[1]) * (displacement - last[0])
        stored = 0.5 * force * displacement
        assert spent == pytest.approx(work - stored, rel=1e-6, abs=1e-9)
        last = displacement, force
        problem.advance()
    assert spent == pytest.approx(ENERGY, rel=1e-6)


def test_snap_back_is_passed_and_told():
    """A brittle bond in soft columns breaks at once; on the way the loads go back."""
    scene, moved = bonded(energy=0.01, stiffness=None)
    problem = scene.problem(options=OPTIONS)
    kink = STRENGTH * 2.0 / YOUNG + 0.1 * 0.01 / STRENGTH
    move(moved, 0.999 * kink)
    problem.solve()
    assert problem.report.damage.path == []
    problem.advance()
    move(moved, 1.001 * kink)
    problem.solve()
    report = problem.report.damage
    assert report.failed == {"bond": problem.results["bond"].damage.size}
    assert report.steps_back >= 1
    assert min(point.factor for point in report.path) < 0.9
    assert report.path[-1].factor == 1.0
    assert np.abs(problem.results["bond"].nodal_normal_force).max() == 0.0
    assert report.dissipated["bond"] == pytest.approx(0.01, rel=1e-6)
    assert "steps back" in " ".join(str(problem.report).split())


def test_loads_beyond_what_bonds_carry():
    """An error that leaves all as it was; load steps find what they carry."""
    scene = columns("quadrilateral")
    traction = scene.add_load(TOP, (0.0, 0.0))
    scene.add_pair(law=Cohesive(STRENGTH, ENERGY), name="bond")
    problem = scene.problem(options={**OPTIONS, "damage_rtol": 1e-6})
    carried = []

    def set_load(t):
        traction.value = (0.0, t)

    with pytest.raises(DamageNotFound, match="the largest share .* is 0.9"):
        for t in problem.steps(set_load, 0.0, 1.1 * STRENGTH, first=0.5 * STRENGTH):
            carried.append(t)
    assert carried[-1] == pytest.approx(STRENGTH, rel=3e-3)
    assert problem.results["bond"].pressure.min() == pytest.approx(-carried[-1], rel=1e-6)


def test_bodies_that_bonds_alone_hold():
    """In space: what they were seen to carry is found by steps that leave bodies free."""
    scene = columns("tetrahedron", 5)
    scene.add_load(TOP, (0.0, 0.0, 1.1 * STRENGTH))
    scene.add_pair(law=Cohesive(STRENGTH, ENERGY), name="bond")
    problem = scene.problem(options={"rtol": 1e-9})
    with pytest.raises(DamageNotFound, match="the bonds break before .* carry is 0.91"):
        problem.solve()


def test_crack_and_contact_where_nothing_is_bonded():
    """A strength that vanishes on a part of the surface: contact there, pressed and open."""
    scene, moved = bonded(strength=lambda x: np.where(x[0] > 0.4, STRENGTH, 0.0), stiffness=None)
    problem = scene.problem(options={"rtol": 1e-9})
    move(moved, 0.004)
    problem.solve()
    bond = problem.results["bond"]
    crack = bond.coordinates[:, 0] < 0.4
    assert (bond.damage == crack).all()
    assert (bond.pressure[crack] == 0.0).all()
    assert (bond.pressure[~crack] < 0.0).all()
    assert problem.report.damage.failed == {"bond": 0}
    move(moved, -0.004)
    problem.solve()
    np.testing.assert_allclose(problem.results["bond"].pressure, 0.002 * YOUNG, rtol=1e-6)


# -- along the surfaces ----------------------------------------------------------------------------


def bilinear(size, strength, energy, stiffness=STIFFNESS):
    """Return the damage at the largest length of a jump so far."""
    elastic, failure = strength / stiffness, 2.0 * energy / strength
    return np.clip(failure * (size - elastic) / (size * (failure - elastic)), 0.0, 1.0)


def blend(share, exponent, strengths=(STRENGTH, 6.0), energies=(ENERGY, 0.12)):
    """Return strength and energy by the law of Benzeggagh and Kenane."""
    part = share**exponent
    strength = np.sqrt(strengths[0] ** 2 + part * (strengths[1] ** 2 - strengths[0] ** 2))
    return strength, energies[0] + part * (energies[1] - energies[0])


def moved_by(cell, upper, comm, **law):
    """Return stiff blocks, whose jump is the displacement of the top, and this."""
    scene, moved = bonded(cell, upper, comm, shear_strength=6.0, shear_energy=0.12, **law)
    scene.young.value = 1e9
    return scene, moved.x.array.reshape(-1, scene.gdim)


@MESHES
def test_mixed_modes(cell, upper):
    """Jumps in several directions, one after the other: damage never heals."""
    scene, moved = moved_by(cell, upper, MPI.COMM_SELF, exponent=1.7)
    problem = scene.problem(options={"rtol": 1e-9, "damage_rtol": 1e-9})
    damage = 0.0
    for along, across in (
        (0.001, 0.0005),
        (0.004, 0.003),
        (0.002, 0.009),
        (0.015, 0.001),
        (0.01, 0.009),
    ):
        jump = np.zeros(scene.gdim)
        jump[0], jump[-1] = along, across
        moved[:] = jump
        problem.solve()
        size = np.hypot(along, across)
        damage = max(damage, bilinear(size, *blend((along / size) ** 2, 1.7)))
        bond = problem.results["bond"]
        np.testing.assert_allclose(bond.damage, damage, rtol=1e-5, atol=1e-9)
        traction = (1.0 - damage) * STIFFNESS * jump
        np.testing.assert_allclose(-bond.pressure, traction[-1], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(bond.friction.traction[:, 0], -traction[0], rtol=1e-4, atol=1e-5)
        problem.advance()
    assert damage < 1.0


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_shear_and_friction_after_failure(cell):
    """On the rising and the falling line, then friction alone, which goes back and forth."""
    bound, half = 1.5, 0.5 * YOUNG
    law = Cohesive(STRENGTH, ENERGY, STIFFNESS, shear_strength=6.0, shear_energy=0.12)
    scene, moved = sheared(cell, law=law, friction=Tresca(bound))
    problem = scene.problem(options=OPTIONS)
    elastic, failure = 6.0 / STIFFNESS, 0.04
    fall = 6.0 / (failure - elastic)
    for displacement in (0.01, 0.03, 0.035, 0.06, 0.05, 0.045):
        shear(moved, displacement)
        problem.solve()
        joint = problem.results["joint"]
        if displacement == 0.01:
            traction = displacement / (2.0 / half + 1.0 / STIFFNESS)
        elif displacement < 0.04:
            traction = fall * (failure - displacement) / (1.0 - fall * 2.0 / half)
        else:
            # slip stops where the way back is as long as the shear of both halves
            traction = {0.06: bound, 0.05: bound - 0.01 * half / 2.0, 0.045: -bound}[displacement]
        np.testing.assert_allclose(joint.friction.traction[:, 0], -traction, rtol=1e-6, atol=1e-8)
        problem.advance()
    assert (joint.damage == 1.0).all()


def test_bonds_that_leave_surfaces_free_to_slide():
    """On a plane of symmetry: no shear strength."""
    law = Cohesive(STRENGTH, ENERGY, shear_strength=0.0)
    scene, moved = sheared(law=law)
    problem = scene.problem(options={"rtol": 1e-9})
    shear(moved, 0.01)
    problem.solve()
    assert problem.results["joint"].friction is None
    assert problem.report.energy == pytest.approx(0.0, abs=1e-12)


def test_coulombs_law_where_bonds_have_failed():
    """Pressed and slid: friction beside bonds that hold, and the bound of what presses."""
    law = Cohesive(lambda x: np.where(x[0] > 0.4, 50.0, 0.0), 5.0)
    scene = columns("quadrilateral")
    moved = pulled(scene, -0.01)
    moved.x.array.reshape(-1, 2)[:, 0] = 0.05
    scene.add_pair(law=law, friction=Coulomb(0.3), name="bond")
    problem = scene.problem(options={"rtol": 1e-8})
    problem.solve()
    bond = problem.results["bond"]
    force, bound = bond.friction.force[:, 0], bond.friction.bound
    crack = bond.damage == 1.0
    assert crack.any() and not crack.all()
    np.testing.assert_allclose(bound[crack], 0.3 * bond.nodal_normal_force[crack], rtol=1e-5)
    assert np.isinf(bound[~crack]).all()
    slips = crack & ~bond.friction.sticking
    np.testing.assert_allclose(np.abs(force[slips]), bound[slips], rtol=1e-6)


@pytest.mark.ranks(2, 3)
def test_mixed_modes_on_several_ranks():
    scene, moved = moved_by("quadrilateral", 5, MPI.COMM_WORLD)
    problem = scene.problem(options={"rtol": 1e-9, "damage_rtol": 1e-9})
    moved[:] = (0.004, 0.003)
    problem.solve()
    damage = bilinear(0.005, *blend(0.64, 2.0))
    np.testing.assert_allclose(problem.results["bond"].damage, damage, rtol=1e-5)


def test_few_nodes_in_a_crack_are_told():
    """The weak part of a bond breaks beside a strong one: once, with both lengths."""

    def two(weak, strong):
        return lambda x: np.where(x[0] < 0.4, weak, strong)

    scene, moved = bonded(strength=two(1.0, 100.0), energy=two(1e-3, 100.0), stiffness=None)
    scene.young.value = 1e6
    problem = scene.problem(options={"rtol": 1e-8})
    move(moved, 3e-3)
    told = "bond' softens at 0 nodes before its crack, over about 0.25 m with facets of 0.25 m"
    with pytest.warns(UserWarning, match=told):
        problem.solve()
    assert 0.0 < problem.results["bond"].damage.mean() < 1.0
    problem.advance()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.solve()
    assert any("before its crack" in text for text in problem.report.to_check)


def test_stiff_bonds_are_told():
    scene, moved = bonded(stiffness=6e4)
    problem = scene.problem(options={"rtol": 1e-8})
    move(moved, 1e-4)
    with pytest.warns(UserWarning, match="bonds that fail at 240 times the opening"):
        problem.solve()


# -- ranks, messages -------------------------------------------------------------------------------


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("upper", [4, 5])
def test_damage_in_checkpoints_on_several_ranks(upper, tmp_path):
    """A run that goes on from a file has the damage of the one before."""
    folder = MPI.COMM_WORLD.bcast(str(tmp_path))
    for step, displacement in enumerate((0.014, 0.005, 0.016)):
        scene, moved = bonded("quadrilateral", upper, MPI.COMM_WORLD)
        problem = scene.problem(options=OPTIONS)
        if step:
            assert problem.restore(f"{folder}/state") == step
        move(moved, displacement)
        problem.solve()
        problem.advance()
        problem.save(f"{folder}/state")
        traction = softened(displacement)
        if displacement == 0.005:
            traction = softened(0.014) * 0.005 / 0.014
        np.testing.assert_allclose(problem.results["bond"].pressure, -traction, rtol=1e-7)
    assert sum(problem.report.damage.failed.values()) == 0


@pytest.mark.parametrize(("data", "message"), [
    ({"energy": 0.0}, "Cohesive: the energy is 0.0; a positive number"),
    ({"strength": -1.0}, "Cohesive: the strength is -1.0"),
    ({"stiffness": 0.0}, "Cohesive: the stiffness is 0.0; a positive number"),
    ({"shear_strength": "no"}, "Cohesive: the shear_strength is 'no'"),
    ({"shear_energy": 0.0}, "Cohesive: the shear_energy is 0.0; a positive number"),
    ({"exponent": -1.0}, "Cohesive: the exponent is -1.0; a positive number"),
])  # fmt: skip
def test_wrong_data_are_named(data, message):
    with pytest.raises(InputError, match=message):
        Cohesive(**{"strength": STRENGTH, "energy": ENERGY, **data})


@pytest.mark.parametrize(("data", "message"), [
    ({"stiffness": 200.0}, "bond: the bond stores more up to its strength than the energy of its "
     "failure at 5 nodes, .* leave it out, or set the strength to zero"),
    ({"energy": lambda x: x[0]}, "has no energy at 1 nodes, the first at .0, 1"),
    ({"stiffness": lambda x: x[0]}, "has no stiffness at 1 nodes"),
    ({"shear_strength": 20.0}, "up to its shear strength than the shear energy"),
])  # fmt: skip
def test_wrong_data_at_nodes_are_named(data, message):
    scene, _ = bonded(**data)
    with pytest.raises(InputError, match=message):
        scene.problem()
