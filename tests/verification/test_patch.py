"""Contact patch test: a uniform state of stress is exact on any mesh, across contact as well.

Blocks of different materials lie on each other, pressed by a uniform pressure. Symmetry planes let
all of them expand and slide on each other, so the displacement is linear in each block:

- across horizontal contacts the stress is uniaxial, u = diag(strain) x + a rise of the block;
- across inclined contacts it is a pressure from all sides, which has no shear on any plane.

Both are in the discrete space; what is left is the solver's tolerance and rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import concatenated, mesh_of, slit, tags_of, unstructured_block
from scenes import Scene, at, elasticity, normal_forces

from fenics_tfeti import ContactProblem
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import tag_facets

pytest.importorskip("gmsh")

PRESSURE = 2e7
HEIGHTS = (1.0, 1.9, 3.0)  # of the blocks' upper faces, at the origin where these are inclined
YOUNG = (2.1e11, 7e10, 1.2e11)
POISSON = (0.3, 0.33, 0.2)
SLOPES = {"horizontal": ((0.0, 0.0), (0.0, 0.0)), "inclined": ((0.3, -0.2), (-0.25, 0.1))}
LOADED, SUPPORTED = 3, (1, 2, 4)
UPPER, LOWER = (10, 11, 12), (20, 21, 22)

# edges of triangles and tetrahedra before they are cut, and unknowns of a subdomain: two or more
# subdomains in each block
SIZES = {
    "triangle": (0.25, 40),
    "quadrilateral": (0.4, 80),
    "tetrahedron": (0.35, 150),
    "hexahedron": (0.7, 300),
}


def faces(contact: str, gdim: int) -> list[tuple[Any, float]]:
    """Return slopes (gdim - 1,) and height at the origin of the blocks' faces, from below."""
    flat = np.zeros(gdim - 1)
    inner = [np.array(slope[: gdim - 1]) for slope in SLOPES[contact]]
    return list(zip([flat, *inner, flat], (0.0, *HEIGHTS), strict=True))


def stack(cell: str, contact: str) -> tuple[Any, Any, Any]:
    """Return the mesh of the blocks, tags of cells and of facets.

    Neighbours are images of one unstructured block in a mirror, so their nodes match at contacts.
    """
    points, cells = unstructured_block(cell, SIZES[cell][0])
    gdim = points.shape[1]
    levels = faces(contact, gdim)
    parts = []
    for k in range(len(YOUNG)):
        x = points.copy()
        below, above = (height + x[:, :-1] @ slope for slope, height in levels[k : k + 2])
        part = x[:, -1] if k % 2 == 0 else 1.0 - x[:, -1]
        x[:, -1] = (1.0 - part) * below + part * above
        parts.append((x, cells))
    points, cells = concatenated(*parts)
    domain = mesh_of(MPI.COMM_SELF, cell, points, cells)
    cell_tags = tags_of(domain, np.repeat(range(len(parts)), len(parts[0][1])))

    def on(slope: Any, height: float) -> Any:
        return lambda x: np.isclose(x[gdim - 1], height + slope @ x[: gdim - 1])

    markers = [(SUPPORTED[axis], at(axis, 0.0)) for axis in range(gdim)]
    markers += [(LOADED, lambda x: np.isclose(x[gdim - 1], HEIGHTS[-1]))]
    if contact == "inclined":
        markers += [(LOADED, at(axis, 1.0)) for axis in range(gdim - 1)]
    for k, (slope, height) in enumerate(levels[1:-1]):
        markers += [(UPPER[k], on(slope, height), k), (LOWER[k], on(slope, height), k + 1)]
    return domain, cell_tags, tag_facets(domain, markers, cell_tags)


def strain(block: int, contact: str, gdim: int) -> Any:
    """Return the strains along the axes (gdim,), in two dimensions for plane strain."""
    nu, unit = POISSON[block], PRESSURE / YOUNG[block]
    if contact == "inclined":
        return np.full(gdim, -unit * (1 - 2 * nu) * (1.0 if gdim == 3 else 1 + nu))
    if gdim == 3:
        return unit * np.array([nu, nu, -1.0])
    return unit * np.array([nu * (1 + nu), -(1 - nu**2)])


def rises(contact: str, gdim: int) -> list[float]:
    """Return how far each block moves up as a whole, so that it touches the one below."""
    found = [0.0]
    levels = faces(contact, gdim)
    for k in range(1, len(YOUNG)):
        jump = strain(k - 1, contact, gdim)[-1] - strain(k, contact, gdim)[-1]
        found.append(found[-1] + jump * levels[k][1])
    return found


@dataclass(frozen=True)
class Patch:
    """A solved patch test; displacements are of shape (nodes, gdim)."""

    problem: ContactProblem
    displacement: Any
    exact: Any


def solved(cell: str, contact: str) -> Patch:
    domain, cell_tags, facet_tags = stack(cell, contact)
    scene, gdim = Scene(domain, facet_tags, cell_tags), domain.geometry.dim
    scene.a = sum(
        elasticity(scene.u, scene.v, scene.constant(young), scene.dx(k), nu)
        for k, (young, nu) in enumerate(zip(YOUNG, POISSON, strict=True))
    )
    scene.add_load(LOADED, -PRESSURE)
    for axis in range(gdim):
        scene.fix(SUPPORTED[axis], axis)
    for k in range(2):
        scene.add_pair(LOWER[k], UPPER[k])
    problem = scene.problem(options={"rtol": 1e-12, "subdomain_size": SIZES[cell][1]})
    uh = problem.solve()
    exact = exact_displacement(scene.V, contact, cell_tags)
    return Patch(problem, uh.x.array.reshape(-1, gdim), exact)


def exact_displacement(V: Any, contact: str, cell_tags: Any) -> Any:
    gdim = V.mesh.geometry.dim
    x, dofs = V.tabulate_dof_coordinates()[:, :gdim], _compat.cell_dofs(V)
    exact = np.empty_like(x)
    for k, rise in enumerate(rises(contact, gdim)):
        nodes = np.unique(dofs[cell_tags.find(k)])
        exact[nodes] = strain(k, contact, gdim) * x[nodes]
        exact[nodes, -1] += rise
    return exact


@pytest.mark.parametrize("contact", SLOPES)
@pytest.mark.parametrize("cell", SIZES)
def test_patch(cell, contact):
    """Displacements are linear in each block, pressures uniform, normals those of the planes."""
    patch = solved(cell, contact)
    largest, gdim = np.abs(patch.exact).max(), patch.exact.shape[1]
    np.testing.assert_allclose(patch.displacement, patch.exact, rtol=0.0, atol=1e-10 * largest)
    slopes = [np.array([*slope[: gdim - 1], -1.0]) for slope in SLOPES[contact]]
    for face, downwards in zip(patch.problem.results, slopes, strict=True):
        np.testing.assert_allclose(face.pressure, PRESSURE, rtol=1e-10)
        normal = downwards / np.linalg.norm(downwards)
        np.testing.assert_allclose(face.normal - normal, 0.0, atol=1e-14)
    forces = PRESSURE * np.linalg.norm(slopes, axis=1)
    np.testing.assert_allclose(normal_forces(patch.problem), forces, rtol=1e-10)
    # each block is torn
    assert np.bincount([s.body for s in patch.problem.system.subdomains]).min() >= 2


def test_closed_crack_is_as_if_it_were_not_there():
    """A square is pressed across its crack, whose faces touch up to the facets at its tip."""
    points, cells = slit(6)
    domain = mesh_of(MPI.COMM_SELF, "quadrilateral", points, cells)
    sides = tags_of(domain, 1 + (points[cells].mean(axis=1)[:, 0] > 3.0))

    def crack(x: Any) -> Any:
        return (x[0] == 3.0) & (x[1] <= 2.0)

    outer = [(SUPPORTED[0], at(0, 0.0)), (SUPPORTED[1], at(1, 0.0)), (LOADED, at(0, 6.0))]
    facet_tags = tag_facets(domain, [*outer, (5, crack, 1), (6, crack, 2)], sides)
    scene = Scene(domain, facet_tags, young=YOUNG[0])
    scene.add_load(LOADED, -PRESSURE)
    for axis in (0, 1):
        scene.fix(SUPPORTED[axis], axis)
    scene.add_pair(5, 6)
    problem = scene.problem(options={"rtol": 1e-12, "subdomain_size": 40})
    uh = problem.solve().x.array.reshape(-1, 2)
    nu, unit = POISSON[0], PRESSURE / YOUNG[0]
    exact = scene.V.tabulate_dof_coordinates()[:, :2] * unit * [-(1 - nu**2), nu * (1 + nu)]
    np.testing.assert_allclose(uh, exact, rtol=0.0, atol=1e-10 * np.abs(exact).max())
    # the last pair of nodes also carries half of the facet at the tip
    assert problem.report.contacts[0].normal_force == pytest.approx(2.5 * PRESSURE, rel=1e-10)
