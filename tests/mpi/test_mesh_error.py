"""The error of the mesh on several ranks: as on one, but for tractions between the ranks."""

from mpi4py import MPI

import numpy as np
import pytest
from mesh_errors import CASES, beams, cells_of, posed
from scenes import Scene, at

import ufl

from fenics_tfeti import MeshError

COMM = MPI.COMM_WORLD


def error_of(scene: Scene) -> MeshError:
    problem = posed(scene)
    problem.solve()
    return problem.mesh_error()


def stacked(comm: MPI.Intracomm) -> MeshError:
    """Return the bound of two blocks, one on the other."""
    parts = [((0.0, low), (1.0, low + 1.0), (12, 12)) for low in (0.0, 1.0)]
    marks = [(1, at(1, 0.0)), (2, at(1, 1.0), 1), (3, at(1, 1.0), 2), (4, at(1, 2.0))]
    scene = Scene.of_boxes(comm, "triangle", parts, [*marks, (5, at(0, 0.0))], young=1.0)
    scene.fix(1, 1)
    scene.fix(5, 0)
    scene.L = -1e-3 * (1 + 2 * ufl.SpatialCoordinate(scene.mesh)[0]) * scene.v[1] * scene.ds(4)
    scene.add_pair(3, 2)
    problem = posed(scene)
    problem.solve()
    return problem.mesh_error(bound=True)


def unlike(comm: MPI.Intracomm) -> Scene:
    return beams(comm, 4, unlike=1.5)


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize(
    "make",
    [
        unlike,
        lambda comm: CASES["roller"](comm, 8, 2, "quadrilateral"),
        lambda comm: CASES["slider"](comm, 8),
        lambda comm: beams(comm, 4, 1, "tetrahedron"),
    ],
    ids=["beams", "roller", "slider", "beams in 3D"],
)
def test_as_on_one_rank(make):
    dealt, alone = (error_of(make(comm)) for comm in (COMM, MPI.COMM_SELF))
    assert dealt.error == pytest.approx(alone.error, rel=0.1)
    assert dealt.energy_norm == pytest.approx(alone.energy_norm, rel=1e-6)
    assert list(dealt.contacts) == list(alone.contacts)
    for name, entry in alone.contacts.items():
        assert dealt.contacts[name].error == pytest.approx(entry.error, rel=0.1)


@pytest.mark.ranks(2, 3)
def test_marked_cells_have_their_share_of_all_ranks():
    estimate = error_of(unlike(COMM))
    W = estimate.cells.function_space
    owned = W.mesh.topology.index_map(W.mesh.topology.dim).size_local
    squares = estimate.cells.x.array[:owned] ** 2
    marked = estimate.mark(0.5)
    assert (marked < owned).all()
    total, of_marked = (COMM.allreduce(part.sum()) for part in (squares, squares[marked]))
    assert 0.5 * total <= of_marked < 0.6 * total
    least = COMM.allreduce(squares[marked].min(initial=np.inf), MPI.MIN)
    others = np.delete(squares, marked)
    assert COMM.allreduce(others.max(initial=0.0), MPI.MAX) < least


@pytest.mark.ranks(2, 3)
def test_bound_is_one_on_all_ranks():
    """Surfaces in contact and their nodes may be on several ranks."""
    dealt, alone = (stacked(comm) for comm in (COMM, MPI.COMM_SELF))
    assert dealt.guaranteed
    assert alone.guaranteed
    assert dealt.energy_norm == pytest.approx(alone.energy_norm, rel=1e-6)
    assert dealt.error == pytest.approx(alone.error, rel=0.1)


@pytest.mark.ranks(2, 3)
def test_tractions_are_as_on_one_rank():
    """Before they are improved: the errors are equal."""
    sums = []
    for comm in (COMM, MPI.COMM_SELF):
        problem = posed(unlike(comm))
        problem.solve()
        squares, _ = cells_of(problem).energies(steps=0)
        sums.append(comm.allreduce(squares.sum(axis=0)))
    assert sums[0] == pytest.approx(sums[1], rel=1e-6)
