"""Products with F for jumps of Young's modulus, by preconditioner and scaling.

    python benchmarks/run.py materials --blocks-per-metre 2 --elements-per-metre 10

The two beams of sec. 11.11.1 consist of cubic blocks that are resolved by an unstructured mesh of
tetrahedra. The modulus jumps between bodies or blocks. The subdomains are either the blocks
("aligned"), or made by SCOTCH without regard to the materials ("cut").
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import gmsh
import numpy as np
from gmsh_files import new_file
from mesh_arrays import of_function
from numpy.typing import NDArray
from scenes import (
    CLAMPED,
    LOADED,
    MASTER,
    ROLLER,
    SLAVE,
    TRACTION,
    YOUNG,
    Scene,
    elasticity,
    support_beams,
)

from dolfinx import fem

from fenics_tfeti import ContactProblem
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.decomposition.partition import split_into_subdomains
from fenics_tfeti.feti import TornSolver, TornSystem, parse_options
from fenics_tfeti.io import TaggedMesh

LOWER, UPPER = 0, 1
CORNERS = {LOWER: (0, 0, 0), UPPER: (1, 0, 1)}
PRECONDITIONERS = ("none", "lumped", "dirichlet")
SCALINGS = ("multiplicity", "stiffness")

Places = NDArray[np.float64]  # midpoints of cells, (3, cells)


# -- materials -----------------------------------------------------------------------------------


def upper(x: Places) -> NDArray[np.bool_]:
    return x[2] > 1.0


def lower(x: Places) -> NDArray[np.bool_]:
    return x[2] < 1.0


def layers(x: Places) -> NDArray[np.bool_]:
    """Layers of half a metre in z."""
    return np.floor(2 * x[2]) % 2 == 0


def slices(x: Places) -> NDArray[np.bool_]:
    """Slices of half a metre in x."""
    return np.floor(2 * x[0]) % 2 == 0


def one_block(x: Places) -> NDArray[np.bool_]:
    return (x[0] > 0.5) & (x[0] < 1.0) & (x[1] < 0.5) & (x[2] > 0.5) & (x[2] < 1.0)


def checkerboard(x: Places) -> NDArray[np.bool_]:
    """Stiff cubes of half a metre that touch each other along edges only."""
    return np.floor(2 * x).sum(axis=0) % 2 == 0


def fibres(x: Places) -> NDArray[np.bool_]:
    """A fibre along the axis of each beam, 0.3 m thick."""
    return np.hypot(x[1] - 0.5, x[2] % 1.0 - 0.5) < 0.15


def inclusions(x: Places) -> NDArray[np.bool_]:
    """Balls of 0.36 m diameter, half a metre apart."""
    return np.linalg.norm(x % 0.5 - 0.25, axis=0) < 0.18


def matrix_of_inclusions(x: Places) -> NDArray[np.bool_]:
    return ~inclusions(x)


def uniform(x: Places) -> NDArray[np.bool_]:
    return np.zeros(x.shape[1], dtype=bool)


@dataclass(frozen=True)
class Case:
    """The stiff part of the material, and whether subdomains are aligned with it."""

    stiff: Callable[[Places], NDArray[np.bool_]]
    aligned: bool

    @property
    def name(self) -> str:
        return f"{self.stiff.__name__.replace('_', ' ')}, {'aligned' if self.aligned else 'cut'}"


CASES = [
    *(Case(stiff, True) for stiff in (uniform, upper, lower, layers, slices, one_block)),
    Case(checkerboard, True),
    *(Case(stiff, False) for stiff in (uniform, upper, lower, layers, slices, checkerboard)),
    *(Case(stiff, False) for stiff in (fibres, inclusions, matrix_of_inclusions)),
]


# the cases without --all
SHORT = (uniform, upper, lower, layers, slices, fibres, inclusions)


# -- mesh ----------------------------------------------------------------------------------------


def add_beam(body: int, blocks_per_metre: int) -> None:
    """Add a beam of blocks that share their faces, each a physical group."""
    size, corner = 1 / blocks_per_metre, np.array(CORNERS[body], float)
    cubes = []
    for place in itertools.product(*map(range, np.array([2, 1, 1]) * blocks_per_metre)):
        cubes.append((3, gmsh.model.occ.addBox(*(corner + size * np.array(place)), *[size] * 3)))
    gmsh.model.occ.fragment(cubes[:1], cubes[1:])
    gmsh.model.occ.synchronize()
    for _, cube in cubes:
        gmsh.model.addPhysicalGroup(3, [cube], 100 + cube)


def surfaces(body: int, axis: int, value: float, low: float, high: float) -> list[int]:
    """Find the surfaces of a body in a plane across an axis, with centres from low to high in x."""
    eps = 1e-6
    first, last = np.array(CORNERS[body], float) - eps, np.array(CORNERS[body], float) + eps
    last += (2, 1, 1)
    first[axis], last[axis] = value - eps, value + eps
    first[0], last[0] = max(first[0], low - eps), min(last[0], high + eps)
    volumes = {cube for _, cube in gmsh.model.getEntitiesInBoundingBox(*box_of(body), 3)}
    found = [tag for _, tag in gmsh.model.getEntitiesInBoundingBox(*first, *last, 2)]
    return [tag for tag in found if volumes.intersection(gmsh.model.getAdjacencies(2, tag)[0])]


def centre(surface: int) -> tuple[float, ...]:
    return tuple(np.round(gmsh.model.occ.getCenterOfMass(2, surface), 6))


def box_of(body: int) -> list[float]:
    corner = np.array(CORNERS[body], float)
    return [*(corner - 1e-6), *(corner + (2, 1, 1) + 1e-6)]


def write_mesh(path: Path, blocks_per_metre: int, elements_per_metre: int) -> None:
    """Mesh the blocks with tetrahedra that match at the contact."""
    with new_file(path):
        for body in CORNERS:
            add_beam(body, blocks_per_metre)
        groups = {
            CLAMPED: surfaces(LOWER, 0, 0.0, 0.0, 0.0),
            ROLLER: surfaces(UPPER, 0, 3.0, 3.0, 3.0),
            SLAVE: surfaces(UPPER, 2, 1.0, 1.0, 2.0),
            MASTER: surfaces(LOWER, 2, 1.0, 1.0, 2.0),
            LOADED: surfaces(UPPER, 2, 2.0, 1.0, 3.0) + surfaces(UPPER, 0, 1.0, 1.0, 1.0),
        }
        for tag, found in groups.items():
            gmsh.model.addPhysicalGroup(2, found, tag)
        gmsh.model.mesh.setSize(gmsh.model.getEntities(0), 1 / elements_per_metre)
        sides = [sorted(groups[side], key=centre) for side in (SLAVE, MASTER)]
        for slave, master in zip(*sides, strict=True):
            gmsh.model.mesh.setPeriodic(2, [slave], [master], np.eye(4).ravel().tolist())
        gmsh.model.mesh.generate(3)


# -- problems ------------------------------------------------------------------------------------


class Beams:
    """A scene of two beams or sheets, with a modulus for each cell."""

    def __init__(self, scene: Scene) -> None:
        mesh, self.scene = scene.mesh, scene
        self.owned = mesh.topology.index_map(scene.gdim).size_local
        self.midpoints = mesh.geometry.x[_compat.geometry_cells(mesh)].mean(axis=1).T
        constant = _compat.lagrange_space(mesh, 0, discontinuous=True)
        self.young = fem.Function(constant)
        self.dof_of_cell = _compat.cell_dofs(constant).ravel()
        scene.a = elasticity(scene.u, scene.v, self.young)

    def cut(self, unknowns: int) -> NDArray[np.int64]:
        """Return the labels of subdomains by SCOTCH."""
        V = self.scene.V
        labels = np.zeros(self.owned, dtype=np.int64)
        bodies = find_bodies(V.mesh, None)
        for number, cells in enumerate(split_into_subdomains(V, bodies, unknowns, "scotch")):
            labels[cells] = number
        return labels

    def problem(
        self, stiff: Callable[[Places], Any], jump: float, subdomains: NDArray[np.int64]
    ) -> ContactProblem:
        """Return the problem where the modulus of a part is larger by a factor."""
        factor = np.where(stiff(self.midpoints), jump, 1.0)
        self.young.x.array[self.dof_of_cell] = YOUNG * factor
        return self.scene.problem(cell_tags=None, subdomains=subdomains)


def two_beams(tagged: TaggedMesh) -> Beams:
    """Return the beams of a mesh."""
    scene = Scene.of(tagged)
    scene.L = scene.constant(-TRACTION) * scene.v[2] * scene.ds(LOADED)
    support_beams(scene)
    scene.add_pair()
    return Beams(scene)


def blocks_of(tagged: TaggedMesh, owned: int) -> NDArray[np.int64]:
    """Return the block of each cell, in the order of the cells."""
    blocks = np.zeros(owned, dtype=np.int64)
    mine = tagged.cell_tags.indices < owned
    blocks[tagged.cell_tags.indices[mine]] = tagged.cell_tags.values[mine]
    return blocks


def measure(system: TornSystem, **options: Any) -> dict[str, Any]:
    """Set up and solve one torn system with some options."""
    every = {"error_if_not_converged": False, **options}
    report = TornSolver(system, parse_options(every)).solve().report
    return {
        **options,
        "products": report.products["total"],
        "preconditioned": report.products["preconditioner"],
        "seconds": report.seconds,
        "converged": report.converged,
        "subdomains": report.subdomains,
        "unknowns": report.unknowns,
        "faces": len(report.faces),
        "outer_iterations": report.outer_iterations,
    }


# -- table ---------------------------------------------------------------------------------------


def run(
    blocks_per_metre=2,
    elements_per_metre=8,
    subdomain_size=450,
    jump=1e4,
    rtol=1e-6,
    max_products=300,
    deflation="off",
    all=False,
):
    """Solve all cases, or the short list, with each preconditioner and scaling.

    Blocks per metre are a multiple of 2; SCOTCH cuts subdomains of `subdomain_size` unknowns; the
    modulus jumps by `jump`. Without deflation, the rows show what scaling alone does.
    """
    tagged = of_function(write_mesh, 3, blocks_per_metre, elements_per_metre, comm=MPI.COMM_WORLD)
    beams = two_beams(tagged)
    blocks, cut, uniform_products = blocks_of(tagged, beams.owned), beams.cut(subdomain_size), {}
    for case in CASES if all else [case for case in CASES if case.stiff in SHORT]:
        problem = beams.problem(case.stiff, jump, blocks if case.aligned else cut)
        for way in itertools.product(PRECONDITIONERS, SCALINGS):
            row = measure(
                problem.system,
                preconditioner=way[0],
                scaling=way[1],
                rtol=rtol,
                max_products=max_products,
                deflation=deflation,
            )
            first = uniform_products.setdefault(way, row["products"])
            yield {"case": case.name, **row, "of uniform": row["products"] / first}
