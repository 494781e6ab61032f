"""Total FETI against the same discrete problem solved as a whole, and against exact totals."""

from __future__ import annotations

from functools import lru_cache

from mpi4py import MPI

import numpy as np
import pytest
from primal_reference import Pair
from scenes import (
    GROUND,
    MASTER,
    SLAVE,
    block_on_ball,
    corner,
    fixed,
    pressed_block,
    stack_on_ground,
    two_beams,
    two_materials,
)

OPTIONS = {"rtol": 1e-8, "subdomain_size": 60, "partitioner": "scotch"}

SMALL = {
    "beams, quadrilaterals": lambda comm: two_beams(comm, "quadrilateral", 6),
    "beams, triangles": lambda comm: two_beams(comm, "triangle", 6),
    "beams, hexahedra": lambda comm: two_beams(comm, "hexahedron", 4),
    "beams, tetrahedra": lambda comm: two_beams(comm, "tetrahedron", 3),
    "beams with a gap": lambda comm: two_beams(comm, "quadrilateral", 6, gap=1e-3),
    "block, quadrilaterals": lambda comm: pressed_block(comm, "quadrilateral", 9),
    "block, triangles, gap": lambda comm: pressed_block(comm, "triangle", 9, gap=4e-4),
    "block, hexahedra": lambda comm: pressed_block(comm, "hexahedron", 4),
    "block, tetrahedra, gap": lambda comm: pressed_block(comm, "tetrahedron", 4, gap=4e-4),
    "block that does not arrive": lambda comm: pressed_block(comm, "quadrilateral", 9, gap=2e-3),
    "ball, triangles": lambda comm: block_on_ball(comm, "triangle", 9),
    "ball, hexahedra": lambda comm: block_on_ball(comm, "hexahedron", 5),
    "corner, quadrilaterals": lambda comm: corner(comm, "quadrilateral", 6),
    "corner, tetrahedra": lambda comm: corner(comm, "tetrahedron", 4),
    "materials, triangles": lambda comm: two_materials(comm, "triangle", 6),
    "materials, hexahedra": lambda comm: two_materials(comm, "hexahedron", 3),
    "stack, quadrilaterals": lambda comm: stack_on_ground(comm, "quadrilateral", 8),
    "stack, tetrahedra": lambda comm: stack_on_ground(comm, "tetrahedron", 4),
}
LARGE = {
    "beams, hexahedra, h = 1/12": lambda comm: two_beams(comm, "hexahedron", 12),
    "beams, tetrahedra, h = 1/8": lambda comm: two_beams(comm, "tetrahedron", 8),
    "beams, triangles, h = 1/32": lambda comm: two_beams(comm, "triangle", 32),
    "materials, tetrahedra, h = 1/8": lambda comm: two_materials(comm, "tetrahedron", 8),
    "stack, hexahedra, h = 1/8": lambda comm: stack_on_ground(comm, "hexahedron", 8),
}
every_scene = pytest.mark.parametrize(
    "name", [*SMALL, *(pytest.param(name, marks=pytest.mark.heavy) for name in LARGE)]
)


@lru_cache(maxsize=None)
def solved(name: str):
    """Return scene, solved problem, displacement and reference of a scene."""
    scene = {**SMALL, **LARGE}[name](MPI.COMM_SELF)
    size = 1000 if name in LARGE else 60 if scene.mesh.topology.dim == 2 else 200
    problem = scene.problem(options={**OPTIONS, "subdomain_size": size})
    return scene, problem, problem.solve(), scene.reference()


def by_node(contact):
    """Return the places that put a contact's nodes in ascending order."""
    return np.argsort(contact.nodes)


@every_scene
def test_displacement(name):
    _, _, uh, reference = solved(name)
    error = np.linalg.norm(uh.x.array - reference.displacement)
    assert error <= 1e-6 * np.linalg.norm(reference.displacement)


@every_scene
def test_contact_forces(name):
    scene, problem, _, reference = solved(name)
    largest = max([contact.forces.max() for contact in reference.contacts] + [1e-3])
    assert len(problem.results) == len(scene.contacts)
    for found, expected in zip(problem.results, reference.contacts, strict=True):
        order = by_node(found)
        np.testing.assert_array_equal(found.nodes[order], expected.nodes)
        np.testing.assert_allclose(
            found.normal_force[order], expected.forces, rtol=0.0, atol=1e-5 * largest
        )


@every_scene
def test_total_contact_force(name):
    scene, problem, _, reference = solved(name)
    exact = scene.total_forces or [contact.forces.sum() for contact in reference.contacts]
    summed = [contact.normal_force.sum() for contact in problem.results]
    np.testing.assert_allclose(
        [c.normal_force for c in problem.report.contacts], exact, rtol=1e-6, atol=1e-3
    )
    np.testing.assert_allclose(summed, exact, rtol=1e-6, atol=1e-3)


@every_scene
def test_gaps_and_normals(name):
    _, problem, _, reference = solved(name)
    for found, expected in zip(problem.results, reference.contacts, strict=True):
        order = by_node(found)
        np.testing.assert_allclose(found.coordinates[order], expected.coordinates, atol=1e-12)
        np.testing.assert_allclose(found.gap[order], expected.gap, atol=1e-12)
        np.testing.assert_allclose(found.normal[order], expected.normal, atol=1e-12)


@every_scene
def test_active_nodes_are_those_that_press(name):
    _, problem, _, _ = solved(name)
    for contact in problem.results:
        np.testing.assert_array_equal(contact.active, contact.normal_force > 0.0)


@every_scene
def test_energy(name):
    _, problem, _, reference = solved(name)
    # abs: rounding of the reference, where a block is moved without strains
    assert problem.report.energy == pytest.approx(reference.energy, rel=1e-8, abs=1e-8)


@every_scene
def test_certificate(name):
    _, problem, _, _ = solved(name)
    certificate = problem.report.certificate
    assert problem.report.converged
    for quantity, number in certificate.numbers().items():
        assert 0.0 <= number <= 1e-8, quantity


@every_scene
def test_there_is_something_to_tear(name):
    scene, problem, _, reference = solved(name)
    assert problem.report.subdomains >= 2
    assert problem.report.unknowns["primal"] == reference.displacement.size
    assert problem.report.unknowns["torn"] > problem.report.unknowns["primal"]


@pytest.mark.parametrize("name", [name for name in SMALL if name.startswith("block")])
def test_uniform_stress_is_exact(name):
    scene, _, uh, _ = solved(name)
    exact = scene.exact(scene.V.tabulate_dof_coordinates().T).T.ravel()
    np.testing.assert_allclose(uh.x.array, exact, rtol=0.0, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("name", [name for name in SMALL if name.startswith("block")])
def test_uniform_pressure_is_exact(name):
    """The area of the tagged surface is 1, so the total force is the pressure."""
    scene, problem, _, _ = solved(name)
    (total,) = scene.total_forces
    np.testing.assert_allclose(problem.results[0].pressure, total, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize(
    "options",
    [
        {"preconditioner": "lumped"},
        {"preconditioner": "dirichlet"},
        {"mprgp_expansion": "standard"},
        {"factor": "mumps"},
        {"smalbe_rho": 3.0},
        {"smalbe_M0": 100.0, "smalbe_eta": 1.0},
        {"partitioner": "auto"},
        {"subdomain_size": 30},
        {"subdomain_size": 100_000},
    ],
    ids=lambda options: ", ".join(f"{name}={value}" for name, value in options.items()),
)
@pytest.mark.parametrize("name", ["beams, quadrilaterals", "materials, triangles"])
def test_options_change_the_way_but_not_the_solution(name, options):
    scene, _, _, reference = solved(name)
    uh = scene.problem(options={**OPTIONS, **options}).solve()
    error = np.linalg.norm(uh.x.array - reference.displacement)
    assert error <= 1e-6 * np.linalg.norm(reference.displacement)


@pytest.mark.parametrize("rtol", [1e-2, 1e-4, 1e-6, 1e-8, 1e-10])
def test_tolerance_means_what_it_says(rtol):
    """The error follows rtol, with the condition of the problem for a factor."""
    scene, _, _, reference = solved("beams, quadrilaterals")
    uh = scene.problem(options={**OPTIONS, "rtol": rtol}).solve()
    error = np.linalg.norm(uh.x.array - reference.displacement)
    assert error <= 30.0 * rtol * np.linalg.norm(reference.displacement)


def test_the_scenes_have_nodes_that_press_and_nodes_that_do_not():
    """Otherwise the inequalities might as well be equations."""
    for name in ("beams, hexahedra", "ball, hexahedra", "materials, triangles"):
        (contact,) = solved(name)[3].contacts
        assert 0 < np.count_nonzero(contact.forces) < contact.forces.size, name


@pytest.mark.heavy
def test_active_nodes_of_the_benchmark():
    """300 of 441 nodes at h = 1/20, as an independent implementation has found."""
    scene = two_beams(MPI.COMM_SELF, "hexahedron", 20)
    problem = scene.problem(options={"rtol": 1e-6})
    problem.solve()
    assert problem.results[0].nodes.size == 441
    assert np.count_nonzero(problem.results[0].active) == 300


# -- what is easily got wrong ----------------------------------------------------------------------


def test_no_contact_is_linear_elasticity():
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral", 9, gap=1.0)
    uh = scene.problem(contacts=[], options=OPTIONS).solve()
    exact = scene.exact(scene.V.tabulate_dof_coordinates().T).T.ravel()
    np.testing.assert_allclose(uh.x.array, exact, rtol=0.0, atol=1e-9)


def test_no_load_is_no_displacement():
    scene = two_beams(MPI.COMM_SELF, "quadrilateral", 6)
    scene.kept[1].value = 0.0
    problem = scene.problem(options=OPTIONS)
    assert np.abs(problem.solve().x.array).max() <= 1e-12
    assert problem.report.converged
    np.testing.assert_allclose([c.normal_force for c in problem.report.contacts], 0.0, atol=1e-3)


def test_node_that_is_prescribed_where_it_touches():
    """The rows say nothing new there, and rounding must not make them a contradiction."""
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral", 6)
    scene.bcs.append(fixed(scene.V, scene.facet_tags, GROUND, 1))
    problem = scene.problem(options=OPTIONS)
    exact = scene.exact(scene.V.tabulate_dof_coordinates().T).T.ravel()
    np.testing.assert_allclose(problem.solve().x.array, exact, rtol=0.0, atol=1e-9)


def test_node_that_sticks():
    """A prescribed tangential component leaves the normal one to the contact."""
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral", 6)
    scene.bcs.append(fixed(scene.V, scene.facet_tags, GROUND, 0))
    uh, expected = scene.problem(options=OPTIONS).solve(), scene.reference().displacement
    assert np.linalg.norm(uh.x.array - expected) <= 1e-6 * np.linalg.norm(expected)


def test_body_that_may_slide_is_solved_and_reported():
    """Without the roller nothing holds the upper beam sideways, but nothing pushes it either."""
    scene = two_beams(MPI.COMM_SELF, "quadrilateral", 6)
    problem = scene.problem(bcs=scene.bcs[:1], options=OPTIONS)
    problem.solve()
    (motion,) = problem.report.free_motions
    assert "translation along (1, 0)" in motion
    np.testing.assert_allclose(
        [c.normal_force for c in problem.report.contacts], scene.total_forces, rtol=1e-6
    )


def test_slave_and_master_may_be_exchanged():
    scene = two_beams(MPI.COMM_SELF, "triangle", 6)
    expected = scene.reference().displacement
    scene.contacts = [Pair(slave=MASTER, master=SLAVE)]
    uh = scene.problem(options=OPTIONS).solve()
    assert np.linalg.norm(uh.x.array - expected) <= 1e-6 * np.linalg.norm(expected)


@pytest.mark.parametrize(
    "arguments",
    [
        {"cell_tags": None},
        {"subdomains": np.arange(144, dtype=np.int32) // 9},
        {"subdomains": np.zeros(144, dtype=np.int32)},
    ],
    ids=["bodies found", "given subdomains", "one label for two bodies"],
)
def test_how_it_is_torn_does_not_matter(arguments):
    scene, _, _, reference = solved("beams, quadrilaterals")
    uh = scene.problem(options=OPTIONS, **arguments).solve()
    error = np.linalg.norm(uh.x.array - reference.displacement)
    assert error <= 1e-6 * np.linalg.norm(reference.displacement)


def test_solving_twice_gives_the_same():
    scene = two_beams(MPI.COMM_SELF, "quadrilateral", 6)
    problem = scene.problem(options=OPTIONS)
    first, second = problem.solve().x.array.copy(), problem.solve().x.array
    assert np.linalg.norm(first - second) <= 1e-8 * np.linalg.norm(first)
    assert problem.report.products["total"] <= 3


@pytest.mark.parametrize("metre", [1e3, 1e-3])
def test_the_unit_of_length_does_not_matter(metre):
    """No absolute tolerance hides in the package."""
    _, _, uh, _ = solved("beams, quadrilaterals")
    scaled = two_beams(MPI.COMM_SELF, "quadrilateral", 6, metre=metre).problem(options=OPTIONS)
    np.testing.assert_allclose(
        np.linalg.norm(scaled.solve().x.array), metre * np.linalg.norm(uh.x.array), rtol=1e-6
    )
