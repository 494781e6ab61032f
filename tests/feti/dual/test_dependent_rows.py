"""Rows that cannot be closed together leave a set, and sites of friction slip."""

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import nnls

from fenics_tfeti.feti.constraints.coupling import Coupling
from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.dual.dependent_rows import _CoupledRows

pytestmark = pytest.mark.once


def remaining(B, chosen, force, gap, sites=None, size=None, radius=None):
    """Return which of the rows B of one node stay on the face, and the forces; -1 for no site."""
    k = len(B)
    sites = np.full(k, -1) if sites is None else sites
    none = np.zeros(k, dtype=bool)
    every = np.arange(k)
    coupling = Coupling(
        every,
        sp.csr_matrix(B @ B.T),
        sp.csr_matrix((k, 0)),
        np.where(sites >= 0, Kind.TANGENT, Kind.CONTACT),
        np.zeros(k),
        every,
        every,
        ~none,
        MPI.COMM_SELF,
    )
    unused = np.zeros(k)
    rows = _CoupledRows(
        coupling,
        chosen.astype(float),
        force.copy(),
        gap,
        sites.astype(float),
        unused if size is None else size,
        unused if radius is None else radius,
    )
    rows.remove_dependent([every])
    return rows.on_face, rows.force


@pytest.mark.parametrize("seed", range(12))
def test_dependent_rows_leave_a_set(seed):
    """The forces on the rows that stay add up to the same, and their work on the gaps is less."""
    rng = np.random.default_rng(seed)
    dimension, k = rng.integers(2, 4), rng.integers(3, 7)
    B = rng.standard_normal((k, dimension))
    B /= np.linalg.norm(B, axis=1)[:, None]
    force, gap, chosen = rng.random(k), rng.standard_normal(k), rng.random(k) < 0.9
    force[~chosen] = 0.0
    stays, _ = remaining(B, chosen, force, gap)
    assert not (stays & ~chosen).any()
    work, left = force @ gap, force @ B
    x, missing = nnls(B[stays].T, left)
    rank = np.linalg.matrix_rank(B[stays])
    if rank == stays.sum():
        assert missing <= 1e-12
        assert gap[stays] @ x <= work + 1e-12
    else:
        # no force would ever vanish: the gaps contradict each other
        y = np.linalg.svd(B[stays].T)[2][rank:]
        assert (y @ gap[stays]).any()


@pytest.mark.parametrize(("difference", "stay"), [(0.0, 3), (1e-11, 2)])
def test_dependent_rows_that_close_together_stay(difference, stay):
    """Differences that are small beside the motion to the closed rows count: a body moves far."""
    normals = np.array([[0.0, 1.0], [0.6, 0.8], [-0.6, 0.8]])
    gap = normals @ [0.3, -0.2] - [difference, 0.0, 0.0]
    stays = remaining(normals, np.ones(3, dtype=bool), np.ones(3), gap)[0]
    assert np.count_nonzero(stays) == stay


@pytest.mark.parametrize(("radius", "slips"), [(0.4, True), (10.0, False)])
def test_site_slips_or_contact_opens_whichever_is_first(radius, slips):
    """A floor with a gap, a wall with friction along it: its slip would be the floor's gap."""
    B = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    force, gap = np.array([1.0, 2.0, 0.1]), np.array([0.5, 0.0, 0.0])
    sites, size = np.array([-1, -1, 0]), np.array([0.0, 0.0, 0.1])
    every = np.ones(3, dtype=bool)
    stays, moved = remaining(B, every, force, gap, sites, size, np.array([0, 0, radius]))
    assert stays.tolist() == ([True, True, False] if slips else [False, True, True])
    # the sum of the forces on the node stays the same
    assert (moved @ B).tolist() == pytest.approx((force @ B).tolist())
    assert moved[2] == pytest.approx(radius if slips else 1.1)


@pytest.mark.parametrize("seed", range(12))
def test_sites_with_two_directions_reach_their_circle(seed):
    """Tangential rows of two walls at a node; the forces on what stays are within their bounds."""
    rng = np.random.default_rng(seed)
    frames = [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2)]
    B = np.concatenate(frames)
    sites = np.array([-1, 0, 0, -1, 1, 1])
    force, gap = rng.random(6), rng.standard_normal(6)
    first = np.hypot(*force[1:3]), np.hypot(*force[4:])
    size = np.array([0.0, first[0], first[0], 0.0, first[1], first[1]])
    radius = 1.1 * size
    stays, moved = remaining(B, np.ones(6, dtype=bool), force, gap, sites, size, radius)
    assert (moved @ B).tolist() == pytest.approx((force @ B).tolist(), abs=1e-12)
    assert moved @ gap < force @ gap
    for at in (slice(1, 3), slice(4, 6)):
        length, bound = np.hypot(*moved[at]), radius[at.start]
        assert stays[at].all() or not stays[at].any()
        assert length == pytest.approx(bound) if not stays[at].any() else length <= bound * 1.0001
    assert np.linalg.matrix_rank(B[stays]) == stays.sum()
