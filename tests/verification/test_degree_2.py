"""Displacements of degree 2: quadratic patch tests, rates of convergence, curved cells."""

from mpi4py import MPI

import numpy as np
import pytest
from curved_rings import quarter_rings
from mortar_blocks import LOWER, UPPER, Blocks, uneven, uneven_problem
from pairwise import pairwise
from scenes import CELLS, POISSON, Scene, at, dimension, normal_forces

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, Deformed, Plane, RigidObstacle, TiedPair

COMM = MPI.COMM_SELF
TOP, BOTTOM, SIDES = 3, 2, (1, 4)
HALF = 0.5


def two_blocks(cell, lower, upper, **more):
    """Mesh two blocks on each other, of together a unit square or cube; tag their surfaces."""
    d = dimension(cell)
    grids = [(n,) * (d - 1) + (max(1, n // 2),) for n in (lower, upper)]
    low, middle = (0.0,) * d, (0.0,) * (d - 1) + (HALF,)
    parts = [(low, (1.0,) * (d - 1) + (HALF,), grids[0]), (middle, (1.0,) * d, grids[1])]
    marks = [(TOP, at(d - 1, 1.0)), (BOTTOM, at(d - 1, 0.0))]
    marks += [
        (SIDES[k], lambda x, k=k: np.isclose(x[k], 0.0) | np.isclose(x[k], 1.0))
        for k in range(d - 1)
    ]
    contact = at(d - 1, HALF)
    marks += [(LOWER, contact, 1), (UPPER, contact, 2)]
    return Scene.of_boxes(COMM, cell, parts, marks, **more)


def joined(kind, tags, slave, d):
    """Return what holds the upper block on the lower one, or the lower one on the ground."""
    if kind == "tied":
        return {"contacts": TiedPair(tags, slave, LOWER + UPPER - slave)}
    pair = ContactPair(tags, slave, LOWER + UPPER - slave)
    if kind == "contact":
        return {"contacts": pair}
    ground = Plane((0.0,) * d, (0.0,) * (d - 1) + (1.0,))
    return {"contacts": [pair, RigidObstacle(tags, BOTTOM, ground)]}


@pytest.mark.parametrize(
    ("cell", "kind", "slave"), pairwise(CELLS, ["contact", "tied", "on obstacle"], [LOWER, UPPER])
)
def test_blocks_under_their_own_weight(cell, kind, slave):
    """Between smooth walls the displacement is quadratic in the height, pressures are uniform."""
    d = dimension(cell)
    load, weight, young = 1e-3, 0.4e-3, 1.0
    sizes = (4, 6) if d == 2 else (2, 3)
    scene = two_blocks(cell, *sizes, degree=2, young=young)
    scene.add_load(TOP, -load)
    scene.L += -scene.constant(weight) * scene.v[d - 1] * ufl.dx
    for k in range(d - 1):
        scene.fix(SIDES[k], k)
    if kind != "on obstacle":
        scene.fix(BOTTOM, d - 1)
    options = {"rtol": 1e-12, "subdomain_size": 150}
    held = joined(kind, scene.facet_tags, slave, d)
    problem = scene.problem(cell_tags=None, options=options, **held)
    uh = problem.solve().x.array.reshape(-1, d)
    y = scene.V.tabulate_dof_coordinates()[:, d - 1]
    modulus = young * (1 - POISSON) / ((1 + POISSON) * (1 - 2 * POISSON))
    exact = -((load + weight) * y - 0.5 * weight * y**2) / modulus
    assert np.abs(uh[:, d - 1] - exact).max() < 1e-10 * np.abs(exact).max()
    assert np.abs(uh[:, : d - 1]).max() < 1e-10 * np.abs(exact).max()
    pressures = [load + weight * (1.0 - HALF), load + weight]
    for contact, pressure in zip(problem.results, pressures, strict=False):
        if kind == "tied":
            pushed = [*[0.0] * (d - 1), pressure if slave == UPPER else -pressure]
            traction = np.broadcast_to(pushed, contact.traction.shape)
            np.testing.assert_allclose(contact.traction, traction, atol=1e-7 * pressure)
            assert contact.area.sum() == pytest.approx(1.0)
            continue
        np.testing.assert_allclose(contact.pressure, pressure, rtol=1e-8)
        assert contact.area.sum() == pytest.approx(1.0)


def smooth_energy(kind, cell, n, degree):
    """Return the energy of blocks under a smooth load; their solution is smooth as well."""
    scene = two_blocks(cell, n, 3 * n // 2, degree=degree, young={1: 1.0, 2: 3.0})
    size = scene.constant(1e-3)
    load = size * (2.0 + ufl.cos(np.pi * ufl.SpatialCoordinate(scene.mesh)[0]))
    ds = scene.ds(TOP, metadata={"quadrature_degree": 8})
    scene.L = -load * scene.v[1] * ds
    scene.fix(BOTTOM, 1)
    scene.fix(SIDES[0], 0)
    held = joined(kind, scene.facet_tags, LOWER, 2)
    problem = scene.problem(cell_tags=None, options={"rtol": 1e-10}, **held)
    uh = problem.solve()
    return -0.5 * fem.assemble_scalar(fem.form(load * uh[1] * ds))


@pytest.mark.once
@pytest.mark.parametrize(("kind", "order"), [("contact", 1.5), ("tied", 2.0)])
def test_order_in_the_energy_norm(kind, order):
    exact = smooth_energy(kind, "quadrilateral", 64, 2)
    errors = np.sqrt(
        [abs(smooth_energy(kind, "quadrilateral", n, 2) / exact - 1.0) for n in (4, 8, 16)]
    )
    orders = np.log2(errors[:-1] / errors[1:])
    assert orders[-1] > order - 0.1
    linear = np.sqrt(abs(smooth_energy(kind, "quadrilateral", 16, 1) / exact - 1.0))
    assert errors[-1] < 0.1 * linear


@pytest.mark.parametrize(
    ("recombine", "slave"),
    [(False, 11), (True, 12)],
    ids=["triangles, inner slave", "quadrilaterals, outer slave"],
)
def test_shrink_fit_with_the_interference_in_the_geometry(tmp_path, recombine, slave):
    """Of curved cells; with straight ones of this size the mean pressure is 12 to 62 % off."""
    a, b, c, excess = 0.5, 1.0, 1.6, 1e-3
    rings = quarter_rings(tmp_path / "a.msh", (12, 17), ((a, b + excess), (b, c)), recombine)
    scene = Scene.of(rings, degree=2, young=1.0)
    scene.fix(13, 1)
    scene.fix(14, 0)
    scene.add_pair(slave, 23 - slave)
    problem = scene.problem(cell_tags=None, options={"rtol": 1e-9})
    problem.solve()
    flexibility = (c**2 + b**2) / (c**2 - b**2) + (b**2 + a**2) / (b**2 - a**2)
    lame = excess / (1 - POISSON**2) / (b * flexibility)
    contact = problem.results[0]
    np.testing.assert_allclose(contact.gap, -excess, rtol=5e-3)
    mean = contact.area @ contact.pressure / contact.area.sum()
    assert mean == pytest.approx(lame, rel=4e-3)
    np.testing.assert_allclose(contact.pressure, lame, rtol=0.02)


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_exact_passes(cell):
    """Rows anew on the deformed surfaces, which are cut at the nodes in the middle of edges."""
    shape = Blocks(cell, 6 if cell == "triangle" else 3, 4, degree=2)
    problem = uneven(shape, gaps=Deformed())
    passes = problem.report.passes
    assert len(passes) > 1
    assert passes[-1].error <= Deformed().tolerance
    assert passes[-1].error < 0.1 * passes[0].error


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_start_from_a_coarse_problem_of_degree_1(cell):
    n = 12 if cell == "triangle" else 4
    blocks = Blocks(cell, n, n + 1, degree=2)
    expected, problem = uneven(blocks), uneven_problem(blocks)
    problem.solve(coarse=uneven(Blocks(cell, n // 2, n // 2 + 1)))
    np.testing.assert_allclose(normal_forces(problem), normal_forces(expected), rtol=1e-8)
    if cell == "triangle":
        assert problem.report.products["total"] < expected.report.products["total"]
