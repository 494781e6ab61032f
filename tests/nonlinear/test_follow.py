"""Paths of equilibria past limit points: an arch that snaps through, freely or onto a floor."""

from mpi4py import MPI

import numpy as np
import pytest
from arches import Arch

from dolfinx import fem

from fenics_tfeti import InputError, NotConverged

pytestmark = pytest.mark.once

# where the load has its largest value before the arch snaps through
LIMIT = 5.7e-5


@pytest.mark.parametrize("size", [20, pytest.param(3000, marks=pytest.mark.heavy)])
def test_path_of_an_arch(size):
    """Each point against displacement control, on which the limit point is an ordinary one."""
    arch, loads = Arch(newton_rtol=1e-8, subdomain_size=size), []
    for t in arch.problem.follow(arch.set_load, 0.0, length=0.03, steps=6):
        loads.append(t)
        assert len(arch.problem.report.newton) <= 6
        assert arch.load.value == t
        assert t == pytest.approx(arch.on_path(arch.lowered()), rel=1e-6)
    assert np.any(np.diff(loads) < 0.0) and np.any(np.diff(loads) > 0.0)
    assert max(loads[:3]) == pytest.approx(LIMIT, rel=0.05)


@pytest.mark.parametrize(
    ("n", "length", "beyond"),
    [(4, 0.05, 3e-4), pytest.param(12, 0.03, 1.05 * LIMIT, marks=pytest.mark.heavy)],
)
def test_arch_on_its_way_to_a_floor(n, length, beyond):
    """The path ends at the equilibrium to which a load beyond the limit point jumps.

    Coarse meshes are so stiff that the arch has no limit point.
    """
    arch, at_floor = Arch(n=n, floor=0.0, newton_rtol=1e-8), []
    for t in arch.problem.follow(arch.set_load, 0.0, length=length, steps=14):
        at_floor.append(arch.problem.results[0].force[1])
        if t > beyond:
            break
    # the floor takes a part of the load
    assert at_floor[0] == 0.0 and 0.1 * t < at_floor[-1] < t
    other = Arch(n=n, floor=0.0, newton_rtol=1e-8)
    other.set_load(t)
    other.problem.solve()
    force = other.problem.results[0].force[1]
    assert at_floor[-1] == pytest.approx(force, rel=1e-5)


@pytest.mark.ranks(2)
def test_path_on_several_ranks():
    paths = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        arch = Arch(n=6, comm=comm, newton_rtol=1e-8, subdomain_size=20)
        paths.append(list(arch.problem.follow(arch.set_load, 0.0, length=0.02, steps=2)))
    np.testing.assert_allclose(*paths, rtol=1e-6)


def test_steps_that_fail_are_halved():
    arch = Arch(newton_max_it=3)
    (load,) = arch.problem.follow(arch.set_load, 0.0, length=0.06, steps=1)
    assert arch.load.value == load
    size = np.sqrt(2.0 * np.mean(arch.u.x.array**2))
    # along the tangent, to the first order, the displacement is as long as the step
    assert np.isclose(size / 0.06, 0.5 ** np.arange(1, 8), rtol=0.05).any()


def test_where_the_shortest_step_fails():
    arch = Arch(newton_max_it=1)
    with pytest.raises(NotConverged, match="after 1 steps"):
        list(arch.problem.follow(arch.set_load, 0.0, length=0.06, steps=1))
    assert arch.load.value == 0.0 and not arch.u.x.array.any()


def test_wrong_arguments():
    arch = Arch()
    follow = arch.problem.follow
    with pytest.raises(InputError, match="follow: set_load is a float; a function of the load"):
        next(follow(1.0, 0.0, length=0.1, steps=1))
    with pytest.raises(InputError, match=r"follow: length is 0.0; a positive number"):
        next(follow(arch.set_load, 0.0, length=0.0, steps=1))
    with pytest.raises(InputError, match="follow: nothing changes with the load at 0"):
        next(follow(lambda t: None, 0.0, length=0.1, steps=1))
    lift = fem.Constant(arch.u.function_space.mesh, 0.0)
    V = arch.u.function_space.sub(0)
    arch.problem.bcs = [*arch.bcs[:1], fem.dirichletbc(lift, arch.bcs[1].dof_indices()[0], V)]
    with pytest.raises(InputError, match="follow: set_load changes prescribed displacements"):
        next(follow(lambda t: setattr(lift, "value", t), 0.0, length=0.1, steps=1))
