"""Torn columns of cubes on elastic supports, with or without contact."""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.sparse as sp
from torn import column, cube, node_rows

from fenics_tfeti.feti import ContactRows, Prescribed, Subdomain, TornSystem


def on_springs(
    subdomain: Subdomain, height: float, stiffness: float, components=(0, 1, 2)
) -> Subdomain:
    """Return a subdomain with springs at its nodes of a height, relative to max|K|."""
    springs = np.zeros((subdomain.nodes.size, 3))
    at = np.flatnonzero(np.isclose(subdomain.coordinates[:, 2], height))
    springs[np.ix_(at, components)] = stiffness * abs(subdomain.stiffness).max()
    K = (subdomain.stiffness + sp.diags(springs.ravel())).tocsr()
    return dataclasses.replace(subdomain, stiffness=K)


def glued_column(stiffness: float, height: int) -> TornSystem:
    """Return glued cubes on springs that nothing else holds."""
    cubes = [cube(2, (0, 0, k), load=(0.1, 0.2, -1.0)) for k in range(height)]
    cubes[0] = on_springs(cubes[0], 0.0, stiffness)
    return TornSystem(cubes, Prescribed(), ContactRows.none(3), 3, ["column"], [])


def pressed_column(stiffness: float, load=(0.2, 0.0, -1.0)) -> TornSystem:
    """Return two bodies in contact, the lower one on springs, the upper one hung up on others."""
    system = column(2, 2, load=load)
    lower, middle, upper = system.subdomains
    lower = on_springs(lower, 0.0, stiffness)
    upper = on_springs(upper, 3.0, stiffness)
    return dataclasses.replace(system, subdomains=[lower, middle, upper], prescribed=Prescribed())


def standing_cube(stiffness: float) -> TornSystem:
    """Return a cube that is pressed onto a floor, and held by springs along z alone."""
    block = cube(2, load=(0.0, 0.0, -1.0))
    foot = block.nodes[block.coordinates[:, 2] == 0.0]
    floor = node_rows(foot, [0.0, 0.0, -1.0], gap=0.01)
    block = on_springs(block, 1.0, stiffness, components=(2,))
    return TornSystem([block], Prescribed(), floor, 3, ["cube"], ["floor"])
