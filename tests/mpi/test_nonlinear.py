"""Contact at finite strains on several ranks: the answers and errors of one rank."""

from mpi4py import MPI

import numpy as np
import pytest
from finite_strains import SLIDER, indented_block, ironing, pressed_patch, squeezed_block

from fenics_tfeti import Coulomb, InputError, NotConverged

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(("make", "arguments", "loads"), [
    (indented_block, (3, 2), [1.0]),
    pytest.param(ironing, (Coulomb(0.3), SLIDER, 3), [1.0, 1.05], marks=pytest.mark.heavy),
])  # fmt: skip
def test_same_as_on_one_rank(make, arguments, loads):
    options = {"newton_rtol": 1e-8, "subdomain_size": 60}
    scene, alone = (make(*arguments, comm=comm, **options) for comm in (COMM, MPI.COMM_SELF))
    scene.solve(loads)
    alone.solve(loads)
    np.testing.assert_allclose(
        scene.problem.results[0].force, alone.problem.results[0].force, atol=1e-7
    )
    assert scene.energy == pytest.approx(alone.energy, abs=1e-7)
    assert abs(scene.counts()[0] - alone.counts()[0]) <= 2


def test_patch():
    friction, options = Coulomb(0.3), {"newton_rtol": 1e-9, "subdomain_size": 60}
    scene, force = pressed_patch(0.2, False, 30.0, friction=friction, **options)
    scene.solve([1.0])
    np.testing.assert_allclose(scene.problem.results[0].force, force, atol=1e-7)


@pytest.mark.ranks(2, 3)
def test_floating_block():
    scene, force = squeezed_block(2, 4, turned=37.0, newton_rtol=1e-9, subdomain_size=60)
    scene.solve([1.0])
    np.testing.assert_allclose(scene.problem.results[0].force, force, atol=1e-8)


def test_errors_are_raised_on_all_ranks():
    scene = indented_block(n=2, newton_max_it=1)
    scene.set_load(1.0)
    with pytest.raises(NotConverged, match="after 1 steps"):
        scene.problem.solve()
    assert not scene.problem.u.x.array.any()
    scene.problem.u.interpolate(lambda x: np.array([0.0 * x[0], -1.5 * x[1]]))
    with pytest.raises(InputError, match="inverted"):
        scene.problem.solve()


def test_checkpoint_of_other_ranks(tmp_path_factory):
    file = COMM.bcast(tmp_path_factory.mktemp("nonlinear") / "step" if COMM.rank == 0 else None)
    scene = indented_block(n=2, newton_rtol=1e-9)
    scene.solve([0.5])
    scene.problem.save(file)
    scene.solve([1.0])
    if COMM.rank == 0:
        other = indented_block(n=2, newton_rtol=1e-9, comm=MPI.COMM_SELF)
        assert other.problem.restore(file) == 1
        other.solve([1.0])
        forces = [one.problem.results[0].force for one in (scene, other)]
        np.testing.assert_allclose(*forces, atol=1e-7)
