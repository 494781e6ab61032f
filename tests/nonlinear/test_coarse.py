"""Newton's method that starts from the solution on a coarser mesh."""

import numpy as np
import pytest
from finite_strains import indented_block, ironing, ring

from fenics_tfeti import InputError, NotConverged

SCENES = {
    "block": lambda n: indented_block(n=4 * n),
    "hexahedra": lambda n: indented_block(3, n=2 * n),
    "pair": lambda n: ironing(n=6 * n),
    "degree 2": lambda n: ring(n=12 * n, across=n),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.heavy] * (name == "hexahedra")) for name in SCENES],
)
def test_fewer_steps_and_the_same_solution(name):
    coarse, fine, alone = (SCENES[name](n) for n in (1, 2, 2))
    for scene in (coarse, fine, alone):
        scene.set_load(1.0)
    coarse.problem.solve()
    uh, expected = fine.problem.solve(coarse=coarse.problem), alone.problem.solve()
    assert fine.counts()[0] <= alone.counts()[0] - (1 if name == "hexahedra" else 2)
    size = np.abs(expected.x.array).max()
    np.testing.assert_allclose(uh.x.array, expected.x.array, atol=2e-6 * size)


@pytest.mark.ranks(2)
def test_meshes_on_several_ranks():
    coarse, fine, alone = (indented_block(n=4 * n) for n in (1, 2, 2))
    for scene in (coarse, fine, alone):
        scene.set_load(1.0)
    coarse.problem.solve()
    fine.problem.solve(coarse=coarse.problem)
    alone.problem.solve()
    assert fine.counts()[0] <= alone.counts()[0] - 2
    forces = [scene.problem.results[0].force[1] for scene in (fine, alone)]
    assert forces[0] == pytest.approx(forces[1], rel=1e-5)


@pytest.mark.once
def test_own_solution_is_an_equilibrium():
    """Displacement and forces: the first step changes nothing, and ends."""
    scenes = [indented_block(n=8) for _ in range(2)]
    for scene in scenes:
        scene.set_load(1.0)
    scenes[0].problem.solve()
    scenes[1].problem.solve(coarse=scenes[0].problem)
    assert scenes[1].counts()[0] == 1
    forces = [scene.problem.results[0].nodal_normal_force for scene in scenes]
    np.testing.assert_allclose(*forces, atol=1e-6 * forces[0].max())


@pytest.mark.once
def test_failure_leaves_the_displacement():
    coarse, fine = indented_block(n=4), indented_block(n=8, newton_max_it=1, newton_rtol=1e-9)
    coarse.solve([1.0])
    fine.set_load(1.0)
    with pytest.raises(NotConverged, match="no equilibrium after 1 steps"):
        fine.problem.solve(coarse=coarse.problem)
    assert not fine.problem.u.x.array.any()


def test_wrong_problems():
    scene = indented_block(n=4)
    with pytest.raises(InputError, match="coarse is a float; a NonlinearContactProblem is"):
        scene.problem.solve(coarse=1.0)
    with pytest.raises(InputError, match="the coarse problem is not solved"):
        scene.problem.solve(coarse=indented_block(n=2).problem)
    with pytest.raises(InputError, match="coarse problem has 3 dimensions, this one has 2"):
        scene.problem.solve(coarse=indented_block(dim=3, n=1).problem)
    with pytest.raises(InputError, match="the coarse problem has the contacts"):
        scene.problem.solve(coarse=ironing(n=3).problem)
