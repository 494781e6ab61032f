"""Hertz's sphere and cylinder on meshes that do not match, against his formulas.

A quarter of a sphere (half of a cylinder) is pressed on a block by displacement control; both are
of Gmsh's unstructured simplices, finer where they touch. Pressure squared falls linearly with the
square of the distance from the axis: its fit gives the peak and the radius of the contact.
"""

from mpi4py import MPI

import numpy as np
import pytest
from msh_files import gmsh_model
from scenes import POISSON, Scene

from fenics_tfeti.io import read_msh, tag_facets

pytestmark = pytest.mark.once

R, DEPTH = 8.0, 0.11
FINE = 1.4  # the region of small elements around the contact
BALL, BLOCK, TOP, BOTTOM, SIDES = 5, 6, 1, 2, (3, 4)


def element_size(sizes, gdim, x):
    """Return the size of the body's elements, which grows away from the contact."""
    own = sizes[0] if x[gdim - 1] > 1e-6 else sizes[1]
    return min(own + 0.35 * max(0.0, np.linalg.norm(x) - FINE), 2.0)


def mesh_of_round_and_block(path, gdim, sizes, degree=1):
    """Mesh both bodies, each with its own size of elements at the contact.

    With degree 2 the cells of the ball are curved.
    """
    with gmsh_model(path, gdim, degree) as gmsh:
        occ = gmsh.model.occ
        if gdim == 3:
            whole = occ.addSphere(0, 0, R, R), occ.addBox(0, 0, 0, R, R, R)
            bodies = [occ.intersect([(3, whole[0])], [(3, whole[1])])[0][0][1]]
            bodies.append(occ.addBox(0, 0, -R, R, R, R))
        else:
            disc = occ.addDisk(0, R, 0, R, R), occ.addRectangle(0, 0, 0, R, R)
            bodies = [occ.intersect([(2, disc[0])], [(2, disc[1])])[0][0][1]]
            bodies.append(occ.addRectangle(0, -R, 0, R, R))
        occ.synchronize()
        for number, body in enumerate(bodies, start=1):
            gmsh.model.addPhysicalGroup(gdim, [body], number)
        gmsh.model.mesh.setSizeCallback(
            lambda dim, tag, x, y, z, *_: element_size(sizes, gdim, np.array([x, y, z]))
        )
        for source in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
            gmsh.option.setNumber(f"Mesh.MeshSize{source}", 0)


def solved(path, gdim, sizes, slave, degree=1):
    mesh_of_round_and_block(path, gdim, sizes, degree)
    bodies = read_msh(path, MPI.COMM_SELF, gdim)
    domain, up = bodies.mesh, gdim - 1

    def near(x):
        return np.linalg.norm(x[: gdim - 1], axis=0) < 2.2

    def on_ball(x):
        away = np.linalg.norm(x[:up], axis=0) ** 2 + (x[up] - R) ** 2
        return np.isclose(np.sqrt(away), R) & near(x) & (x[up] < 0.5 * R)

    markers = [(BALL, on_ball, 1), (BLOCK, lambda x: np.isclose(x[up], 0.0) & near(x), 2)]
    markers += [(TOP, lambda x: np.isclose(x[up], R)), (BOTTOM, lambda x: np.isclose(x[up], -R))]
    markers += [(SIDES[k], lambda x, k=k: np.isclose(x[k], 0.0)) for k in range(up)]
    tags = tag_facets(domain, markers, bodies.cell_tags)
    scene = Scene(domain, tags, bodies.cell_tags, degree, young=1.0)
    scene.fix(TOP, up, -DEPTH)
    scene.fix(BOTTOM, up)
    for k in range(up):
        scene.fix(SIDES[k], k)
    scene.add_pair(slave, BALL + BLOCK - slave)
    problem = scene.problem(options={"rtol": 1e-6})
    problem.solve()
    return problem


def errors(problem):
    """Return the relative errors of peak, radius, pressure in L2, and a / h of the contact."""
    gdim, contact = problem.system.gdim, problem.results[0]
    force = abs(problem.report.contacts[0].force[-1])
    modulus = 1.0 / (2.0 * (1.0 - POISSON**2))
    if gdim == 3:
        force *= 4.0
        a = (3.0 * force * R / (4.0 * modulus)) ** (1.0 / 3.0)
        peak = 3.0 * force / (2.0 * np.pi * a * a)
    else:
        force *= 2.0
        a = np.sqrt(4.0 * force * R / (np.pi * modulus))
        peak = 2.0 * force / (np.pi * a)
    r = np.linalg.norm(contact.coordinates[:, : gdim - 1], axis=1)
    exact = peak * np.sqrt(np.maximum(0.0, 1.0 - (r / a) ** 2))
    inside = r < 0.9 * a
    slope, height = np.polyfit(
        r[inside] ** 2, contact.pressure[inside] ** 2, 1, w=np.sqrt(contact.area[inside])
    )
    square = contact.area @ (contact.pressure - exact) ** 2 / (contact.area @ exact**2)
    return (np.sqrt(height) / peak - 1.0, np.sqrt(-height / slope) / a - 1.0, np.sqrt(square), a)


@pytest.fixture(scope="module")
def exact_force(tmp_path_factory):
    """Of cells a quarter as large, curved."""
    path = tmp_path_factory.mktemp("meshes") / "fine.msh"
    return solved(path, 2, (0.025, 0.035), BALL, 2).report.contacts[0].normal_force


@pytest.mark.parametrize("slave", [BALL, BLOCK], ids=["cylinder", "block"])
def test_cylinder(tmp_path, slave, exact_force):
    """Of straight cells and of curved ones, a seventh of half the contact's width.

    The force is twice the energy over the depth.
    """
    linear, quadratic = (
        solved(tmp_path / f"{degree}.msh", 2, (0.1, 0.14), slave, degree) for degree in (1, 2)
    )
    off = [abs(p.report.contacts[0].normal_force / exact_force - 1.0) for p in (linear, quadratic)]
    assert off[1] < off[0] / 3.0
    of_linear, of_quadratic = errors(linear), errors(quadratic)
    assert 7.0 < of_linear[3] / 0.1 < 8.0
    assert (np.abs(of_linear[:3]) < (0.03, 0.04, 0.12)).all()
    assert (np.abs(of_quadratic[:3]) < (0.01, 0.02, 0.02)).all()


@pytest.mark.heavy
@pytest.mark.parametrize("slave", [BALL, BLOCK], ids=["sphere", "block"])
def test_sphere_with_degree_2(tmp_path, slave):
    linear, quadratic = (
        errors(solved(tmp_path / f"{degree}.msh", 3, (0.14, 0.12), slave, degree))
        for degree in (1, 2)
    )
    peak, radius, square, _ = np.abs(quadratic)
    assert peak < 0.01
    assert radius < 0.01
    assert square < 0.04
    assert square < 0.5 * linear[2]
