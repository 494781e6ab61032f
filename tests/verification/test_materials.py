"""Materials that jump, and units that change: the same numbers of products, the same solution.

Two beams of unstructured tetrahedra, one upon the other's end, each of two cubes. The cubes are
bodies of their own for the partition, so that jumps from cube to cube follow subdomains.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import concatenated, merged, mesh_of, tags_of, unstructured_block
from scenes import (
    CLAMPED,
    LOADED,
    MASTER,
    ROLLER,
    SLAVE,
    TRACTION,
    YOUNG,
    Scene,
    at,
    elasticity,
    scalar_space,
    support_beams,
)

from dolfinx import fem

from fenics_tfeti.fem import _compat
from fenics_tfeti.io import tag_facets

pytestmark = pytest.mark.once

pytest.importorskip("gmsh")

SIZE = 0.35  # of the edges
SUBDOMAIN = 100  # unknowns
JUMP = 1e4
# moduli of the cubes, from x = 0 to the end of each beam, the lower one's first
MODULI = {
    "uniform": (1.0, 1.0, 1.0, 1.0),
    "upper body stiff": (1.0, 1.0, JUMP, JUMP),
    "lower body stiff": (JUMP, JUMP, 1.0, 1.0),
    "second and fourth cube stiff": (1.0, JUMP, 1.0, JUMP),
    "cubes on each other stiff": (1.0, JUMP, JUMP, 1.0),
}
# (metre, pascal) in other units; newtons follow
UNITS = {"mm, MPa": (1e3, 1e-6), "km, Pa": (1e-3, 1.0)}


@lru_cache(maxsize=None)
def cubes() -> tuple[Any, Any]:
    """Return points and cells of four cubes, images of one in mirrors; beams are glued."""
    unit, cells = unstructured_block("tetrahedron", SIZE)

    def image(*corner: int) -> Any:
        turned = np.array(corner) % 2
        return corner + turned + (1.0 - 2.0 * turned) * unit, cells

    beams = [
        merged(*concatenated(image(first, 0, first), image(first + 1, 0, first)))
        for first in (0, 1)
    ]
    return concatenated(*beams)


def scene(
    moduli: tuple[float, ...] = MODULI["uniform"],
    gap: float = 0.0,
    metre: float = 1.0,
    pascal: float = 1.0,
) -> Scene:
    """Return the chapter's benchmark with a modulus for each cube.

    `gap` [m] is between the beams; `metre` and `pascal` are what these are in the units used.
    """
    points, cells = cubes()
    middle = points[cells].mean(axis=1)
    upper = middle[:, 2] > 1.0
    raised = points.copy()
    raised[np.unique(cells[upper]), 2] += gap
    domain = mesh_of(MPI.COMM_SELF, "tetrahedron", metre * raised, cells)
    cube = tags_of(domain, 2 * upper + np.floor(middle[:, 0] - upper))

    def end(height: float) -> Any:
        return lambda x: at(2, metre * height)(x) & (0.99 * metre < x[0]) & (x[0] < 2.01 * metre)

    facet_tags = tag_facets(
        domain,
        [
            (CLAMPED, at(0, 0.0), 0),
            (ROLLER, at(0, 3.0 * metre), 1),
            (LOADED, at(2, metre * (2.0 + gap)), 1),
            (LOADED, at(0, metre), 1),
            (SLAVE, end(1.0 + gap), 1),
            (MASTER, end(1.0), 0),
        ],
        tags_of(domain, upper),
    )
    scene = Scene(domain, facet_tags, cube)
    constant = scalar_space(domain, "DG", 0)
    scene.young = fem.Function(constant)
    of_cell = _compat.cell_dofs(constant).ravel()[cube.indices]
    scene.young.x.array[of_cell] = pascal * YOUNG * np.array(moduli)[cube.values]
    scene.a = elasticity(scene.u, scene.v, scene.young)
    scene.add_load(LOADED, np.array([0.0, 0.0, -TRACTION * pascal]))
    support_beams(scene)
    scene.add_pair()
    scene.total_forces = [3.0 * TRACTION * pascal * metre**2]
    return scene


def with_fibres() -> Scene:
    """Return the uniform beams with a stiff fibre along each axis, which subdomains cut."""
    what = scene()
    young = what.young
    places = young.function_space.tabulate_dof_coordinates()
    inside = np.hypot(places[:, 1] - 0.5, places[:, 2] % 1.0 - 0.5) < 0.2
    young.x.array[inside] *= JUMP
    return what


def solved(what: Scene, **options: Any) -> tuple[Any, Any]:
    """Return the solved problem and its displacement."""
    problem = what.problem(
        options={"subdomain_size": SUBDOMAIN, "partitioner": "scotch", **options}
    )
    return problem, problem.solve().x.array


def products(name: str, preconditioner: str, scaling: str) -> int:
    problem, _ = solved(scene(MODULI[name]), preconditioner=preconditioner, scaling=scaling)
    assert problem.report.subdomains == 12
    return problem.report.products["total"]


@pytest.mark.parametrize("preconditioner", ["lumped", "dirichlet"])
def test_aligned_jumps_cost_at_most_twice_the_products(preconditioner):
    found = {name: products(name, preconditioner, "stiffness") for name in MODULI}
    assert max(found.values()) <= 2 * found["uniform"], found


@pytest.mark.parametrize("name", ["upper body stiff", "second and fourth cube stiff", "fibres"])
def test_displacement(name):
    """The error follows rtol, where jumps are inside subdomains with the condition for a factor."""
    what = with_fibres() if name == "fibres" else scene(MODULI[name])
    expected, factor = what.reference().displacement, 30.0 if name == "fibres" else 1.0
    for rtol in (1e-4, 1e-8):
        _, u = solved(what, rtol=rtol)
        assert np.linalg.norm(u - expected) <= factor * rtol * np.linalg.norm(expected), rtol


def in_units(units: str, gap: float) -> tuple[Scene, Any, Any]:
    metre, pascal = {**UNITS, "m, Pa": (1.0, 1.0)}[units]
    what = scene(MODULI["upper body stiff"], gap, metre, pascal)
    problem, u = solved(what)
    return what, problem, u / metre


@pytest.mark.parametrize("gap", [0.0, 2e-3])
def test_units_change_nothing(gap):
    """Products, displacements and forces are the same, and so is the certificate's meaning."""
    scene_, problem, u = in_units("m, Pa", gap)
    products = problem.report.products["total"]
    forces = problem.results[0].nodal_normal_force / scene_.total_forces[0]
    for units in UNITS:
        other, found, v = in_units(units, gap)
        report = found.report
        assert abs(report.products["total"] - products) <= 0.05 * products, units
        assert np.linalg.norm(v - u) <= 1e-6 * np.linalg.norm(u), units
        relative = found.results[0].nodal_normal_force / other.total_forces[0]
        np.testing.assert_allclose(relative, forces, rtol=0.0, atol=1e-6, err_msg=units)
        assert relative.sum() == pytest.approx(1.0, rel=1e-6), units
        assert report.converged and report.certificate.worst <= 1e-6, units
