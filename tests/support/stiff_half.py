"""A block of which one half is much stiffer: stiff subdomains that hang on soft ones."""

from __future__ import annotations

import itertools
from dataclasses import replace

from mpi4py import MPI

import numpy as np
from torn import cube, fixed_nodes

from fenics_tfeti.feti import ContactRows, Subdomain, TornSystem

SIDE = 2  # cubes


def stiff_half(
    jump: float, pressed: bool = False, n: int = 3, comm: MPI.Intracomm = MPI.COMM_SELF
) -> TornSystem:
    """Return a block of 16 glued cubes with a load of 16 N, the upper half `jump` times stiffer.

    It is clamped at its lower face and bends, or it is pressed on a rigid plane, with its top held
    against sliding. This rank's share of the cubes.
    """
    corners = list(itertools.product(range(SIDE), range(SIDE), range(2 * SIDE)))
    load = (0, 0, -1) if pressed else (1, 0, 0)
    cubes = [_scaled(cube(n, at, load=load), jump if at[2] >= SIDE else 1.0) for at in corners]
    height = 2 * SIDE if pressed else 0
    components = [0, 1] if pressed else [0, 1, 2]
    held = _nodes_at(cubes, height)
    fixed = fixed_nodes(held, components)
    rows = ContactRows.none(3)
    if pressed and comm.rank == 0:
        slaves = _nodes_at(cubes, 0)
        k = slaves.size
        down = np.tile([0.0, 0.0, -1.0], (k, 1))
        rows = ContactRows(np.arange(k + 1), slaves, down, np.zeros(k), np.zeros(k, dtype=np.int64))
    names = ["plane"] if pressed else []
    return TornSystem(cubes[comm.rank :: comm.size], fixed, rows, 3, ["block"], names, comm)


def _scaled(subdomain: Subdomain, factor: float) -> Subdomain:
    return replace(subdomain, stiffness=factor * subdomain.stiffness)


def _nodes_at(cubes: list[Subdomain], height: float) -> np.ndarray:
    found = [s.nodes[np.isclose(s.coordinates[:, 2], height)] for s in cubes]
    return np.unique(np.concatenate(found))
