"""Adhesion of limited energy, in columns of uniform stress and on stiff blocks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from columns import MESHES, TOP, YOUNG, columns, pulled

from fenics_tfeti import (
    Adhesive,
    Cohesive,
    ContactPair,
    Coulomb,
    DamageNotFound,
    InputError,
    UnresistedMotion,
)
from fenics_tfeti.fem.contact.descriptions.arguments import as_contacts

# mm-N-MPa; adhesion ends at the opening 0.01, with columns that are longer by 0.006
TRACTION, ENERGY = 3.0, 0.03
OPTIONS = {"rtol": 1e-11, "subdomain_size": 60}


def glued(cell="quadrilateral", upper=4, comm=MPI.COMM_SELF, law=None, **interface):
    """Return columns with adhesion, and what moves their top."""
    scene = columns(cell, upper, comm)
    moved = pulled(scene, 0.0)
    scene.add_pair(law=law or Adhesive(TRACTION, ENERGY), name="glue", **interface)

    def move(displacement, along=0.0):
        components = moved.x.array.reshape(-1, scene.gdim)
        components[:, 0], components[:, -1] = along, displacement

    return scene, move


@MESHES
def test_adhesion_holds_opens_and_ends(cell, upper):
    """The traction is that of a displacement, there and back, until the opening is too large."""
    scene, move = glued(cell, upper)
    problem = scene.problem(options=OPTIONS)
    spent, work, last, end = 0.0, 0.0, (0.0, 0.0), 0.016
    for displacement in (0.004, 0.006, 0.012, 0.006, -0.004, 0.006, 0.99 * end, 1.01 * end, 0.003):
        move(displacement)
        problem.solve()
        glue, ended = problem.results["glue"], max(displacement, last[0]) > end
        traction = 0.0 if ended else min(0.5 * YOUNG * displacement, TRACTION)
        np.testing.assert_allclose(glue.pressure, -traction, rtol=1e-9, atol=1e-9)
        opening = displacement - 2.0 * traction / YOUNG
        np.testing.assert_allclose(glue.opening, opening, rtol=1e-9, atol=1e-11)
        assert (glue.damage == ended).all()
        spent += problem.report.damage.dissipated["glue"]
        work += 0.5 * (traction + last[1]) * (displacement - last[0])
        last = displacement, traction
        problem.advance()
    assert problem.report.damage.failed == {"glue": glue.damage.size}
    assert spent == pytest.approx(ENERGY, rel=1e-9)
    # what the columns have stored is free when the adhesion ends, half-way in the last step
    assert work == pytest.approx(ENERGY + TRACTION**2 / YOUNG, rel=1e-9)
    move(-0.002)
    problem.solve()
    np.testing.assert_allclose(problem.results["glue"].pressure, 0.001 * YOUNG, rtol=1e-9)


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("upper", [4, 5])
def test_energy_that_varies(upper, tmp_path):
    """Stiff blocks come off where the traction on their opening is more; in checkpoints, too."""
    folder = MPI.COMM_WORLD.bcast(str(tmp_path))
    law = Adhesive(TRACTION, lambda x: TRACTION * (0.01 + 0.01 * x[0]))
    before = 0.0
    for step, (displacement, farthest) in enumerate(
        [(0.0136, 0.0136), (0.005, 0.0136), (0.018,) * 2]
    ):
        scene, move = glued(upper=upper, comm=MPI.COMM_WORLD, law=law)
        scene.young.value = 1e9
        problem = scene.problem(options={"rtol": 1e-9})
        if step:
            assert problem.restore(f"{folder}/state") == step
        move(displacement)
        problem.solve()
        glue, damage = problem.results["glue"], problem.report.damage
        reach = 0.01 + 0.01 * glue.coordinates[:, 0]
        ended = reach < farthest
        np.testing.assert_array_equal(glue.damage, ended)
        np.testing.assert_allclose(glue.pressure, np.where(ended, 0.0, -TRACTION), rtol=1e-9)
        taken = MPI.COMM_WORLD.allreduce(float((TRACTION * reach * glue.area)[ended].sum()))
        assert damage.dissipated["glue"] == pytest.approx(taken - before, rel=1e-9)
        before = taken
        problem.advance()
        problem.save(f"{folder}/state")


def test_a_crack_runs_by_itself():
    """What ends loads the next nodes: passes go on until all that is left holds."""
    scene, move = glued(law=Adhesive(TRACTION, lambda x: 1e-3 * (1.0 + x[0])))
    problem = scene.problem(options={"rtol": 1e-9})
    # the node with the least energy opens by more than it takes only where columns are longer
    move(0.00635)
    problem.solve()
    glue, damage = problem.results["glue"], problem.report.damage
    reach, holds = 1e-3 * (1.0 + glue.coordinates[:, 0]) / TRACTION, glue.damage == 0.0
    assert damage.passes > 2
    assert 0 < damage.failed["glue"] == np.count_nonzero(~holds)
    assert (glue.opening[holds] <= reach[holds]).all()


@pytest.mark.parametrize(("gap", "pressure"), [(0.004, -2.0), (0.009, -TRACTION), (0.011, 0.0)])
def test_surfaces_that_are_apart_at_first(gap, pressure):
    """They adhere, or are pulled together, if they are near enough."""
    scene, _ = glued(initial_gap=gap)
    problem = scene.problem(options=OPTIONS)
    problem.solve()
    glue = problem.results["glue"]
    np.testing.assert_allclose(glue.pressure, pressure, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(glue.damage, pressure == 0.0)
    assert problem.report.damage.dissipated == {"glue": 0.0}


def test_friction_of_adhesion_and_after_its_end():
    """Coulomb's bound counts the traction of what adheres alone."""
    law = Adhesive(TRACTION, lambda x: np.where(x[0] > 0.4, ENERGY, 1e-6))
    scene, move = glued(law=law, friction=Coulomb(0.3))
    problem = scene.problem(options={"rtol": 1e-8})
    move(0.008, along=0.05)
    problem.solve()
    glue = problem.results["glue"]
    bound = 0.3 * (glue.nodal_normal_force + np.where(glue.damage > 0.0, 0.0, TRACTION * glue.area))
    assert 0.0 < glue.damage.mean() < 1.0
    np.testing.assert_allclose(glue.friction.bound, bound, rtol=1e-5, atol=1e-7)


def test_loads_that_adhesion_does_not_carry():
    """An error that leaves all as it was, in load steps, too."""
    law = Adhesive(lambda x: np.where(x[0] < 0.4, 1.0, 6.0), 0.002)
    scene = columns("quadrilateral")
    traction = scene.add_load(TOP, (0.0, 0.0))
    scene.add_pair(law=law, name="glue")
    problem = scene.problem(options={"rtol": 1e-8})

    def set_load(t):
        traction.value = (0.0, t)

    set_load(3.0)
    with pytest.raises(UnresistedMotion):
        problem.solve()
    carried = []
    with pytest.raises(DamageNotFound, match="adhesion ends before the loads are reached"):
        for t in problem.steps(set_load, 0.0, 2.5, first=1.0):
            carried.append(t)
    assert 1.0 <= carried[-1] < 2.5
    assert problem.results["glue"].damage.mean() < 1.0


@pytest.mark.parametrize(("wrong", "message"), [
    (lambda: Adhesive(1.0, -1.0), "Adhesive: the energy is -1.0; a positive number"),
    (lambda: as_contacts([pair(Adhesive(1.0, 1.0)), pair(Cohesive(1.0, 1.0))]),
     "Adhesive and Cohesive need solves of their own"),
    (lambda: glued(law=Adhesive(1.0, lambda x: x[0]))[0].problem(),
     "glue: the bond has no energy at 1 nodes, .* set the traction to zero there"),
])  # fmt: skip
def test_wrong_data_are_named(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


def test_derivatives_know_no_adhesion_that_ends():
    scene, move = glued()
    problem = scene.problem()
    move(0.004)
    problem.solve()
    with pytest.raises(InputError, match="know no law Adhesive with an energy"):
        problem.adjoint(normal_forces={"glue": 1.0})


def pair(law):
    return ContactPair(columns("quadrilateral").facet_tags, 5, 6, law=law)
