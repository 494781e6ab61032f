"""Tangents of compressed bodies without dolfinx: a block and a punch that is pressed into it.

To the stiffness of a grid comes that of a uniform stress, K_ab = int grad N_a'S grad N_b I. Torn
subdomains are then indefinite: compression drives their rotations, and slender ones buckle.
"""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
from fibres import FAR, subdomain
from lattice import element_of_stress, grid_stiffness
from torn import fixed_nodes, node_rows

from fenics_tfeti.feti import ContactRows, Prescribed, Subdomain, TornSystem

DEPTH = 0.3
FIELDS = ("nodes", "components", "values")


def stressed(part: Subdomain, stress: np.ndarray) -> Subdomain:
    """Return a grid of `fibres.subdomain` with the stiffness of a stress added."""
    shape = np.rint(np.ptp(part.coordinates, axis=0)).astype(int)
    added = grid_stiffness(tuple(shape.tolist()), element_of_stress(stress))
    return replace(part, stiffness=(part.stiffness + added).tocsr())


def compression(gdim: int, pressure: float) -> np.ndarray:
    """Return a uniaxial stress along the last axis."""
    stress = np.zeros((gdim, gdim))
    stress[-1, -1] = -pressure
    return stress


def pressed_block(
    gdim: int = 2,
    pressure: float = 0.05,
    *,
    shape: tuple[int, ...] = (),
    columns: int = 3,
    layers: int = 2,
    clamped: bool = True,
    comm: MPI.Intracomm = MPI.COMM_SELF,
) -> TornSystem:
    """Return a compressed block, clamped at its base, with a compressed punch; this rank's share.

    In 3D block and punch are two elements deep. The pressure is that in all subdomains, of Young's
    modulus 1 and `shape` elements; the block has `columns` by `layers` of them, the punch those in
    the middle. The top of the punch is moved down if it is clamped, otherwise it is loaded downward
    and may not move sideways: only contact then holds it against rotations.
    """
    shape = shape or ((6, 6) if gdim == 2 else (3, 2, 3))
    stress = compression(gdim, pressure)

    def part(i: int, j: int, body: int) -> Subdomain:
        corner = (shape[0] * i, *[0] * (gdim - 2), shape[-1] * j)
        return stressed(subdomain(corner, shape, lambda x: np.ones(len(x)), body), stress)

    middle = range((columns - 1) // 2, columns // 2 + 1)
    block = [part(i, j, 0) for i in range(columns) for j in range(layers)]
    punch = [part(i, layers, 1) for i in middle]
    base = np.concatenate([s.nodes[s.coordinates[:, -1] == 0.0] for s in block])
    height = (layers + 1.0) * shape[-1]
    top = np.unique(np.concatenate([s.nodes[s.coordinates[:, -1] == height] for s in punch]))
    still = fixed_nodes(np.unique(base), range(gdim)), fixed_nodes(top, range(gdim - 1))
    moved = fixed_nodes(top, [gdim - 1], -DEPTH)
    parts = (*still, moved) if clamped else still
    prescribed = Prescribed(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in FIELDS)
    )
    if not clamped:
        for s in punch:
            loaded = np.flatnonzero(s.coordinates[:, -1] == height)
            s.load[gdim * loaded + gdim - 1] = -0.1 / loaded.size
    faces = [s.coordinates[:, -1] == layers * shape[-1] for s in punch]
    slaves = np.concatenate([s.nodes[f] for s, f in zip(punch, faces, strict=True)])
    slaves, first = np.unique(slaves, return_index=True)
    x = np.concatenate([s.coordinates[f] for s, f in zip(punch, faces, strict=True)])[first]
    # the face of the punch is round
    width = len(middle) * shape[0]
    gap = 0.2 * DEPTH * (2.0 * (x[:, 0] - x[:, 0].mean()) / width) ** 2
    rows = node_rows(slaves, -np.eye(gdim)[-1], slaves - FAR**gdim, gap)
    return TornSystem(
        [*block, *punch][comm.rank :: comm.size],
        prescribed if comm.rank == 0 else Prescribed(),
        rows if comm.rank == 0 else ContactRows.none(gdim),
        gdim,
        ["block", "punch"],
        ["joint"],
        comm,
    )
