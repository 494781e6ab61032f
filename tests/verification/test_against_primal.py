"""Total FETI against the same discrete problem solved as a whole, and against exact totals."""

from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from primal_reference import nodes_of
from scenes import (
    GROUND,
    MASTER,
    SLAVE,
    block_on_ball,
    corner,
    normal_forces,
    pressed_block,
    stack_on_ground,
    two_beams,
    two_materials,
)

COMM = MPI.COMM_WORLD
OPTIONS = {"rtol": 1e-8, "subdomain_size": 60, "partitioner": "scotch"}

SMALL = {
    "beams, quadrilaterals": lambda comm: two_beams(comm, "quadrilateral", 6),
    "beams, hexahedra": lambda comm: two_beams(comm, "hexahedron", 4),
    "beams with a gap": lambda comm: two_beams(comm, "quadrilateral", 6, gap=1e-3),
    "block, triangles, gap": lambda comm: pressed_block(comm, "triangle", 9, gap=4e-4),
    "block, hexahedra": lambda comm: pressed_block(comm, "hexahedron", 4),
    "block, tetrahedra, gap": lambda comm: pressed_block(comm, "tetrahedron", 4, gap=4e-4),
    "block that does not arrive": lambda comm: pressed_block(comm, "quadrilateral", 9, gap=2e-3),
    "ball, hexahedra": lambda comm: block_on_ball(comm, "hexahedron", 5),
    "corner, tetrahedra": lambda comm: corner(comm, "tetrahedron", 4),
    "materials, triangles": lambda comm: two_materials(comm, "triangle", 6),
    "stack, quadrilaterals": lambda comm: stack_on_ground(comm, "quadrilateral", 8),
}
ON_RANKS = {
    "beams, hexahedra",
    "block, tetrahedra, gap",
    "materials, triangles",
    "stack, quadrilaterals",
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


@cache
def solved(name, alone=True):
    """Return the solved problem of a scene, on one rank or all, and the displacement."""
    scene = {**SMALL, **LARGE}[name](MPI.COMM_SELF if alone else COMM)
    size = 1000 if name in LARGE else 60 if scene.mesh.topology.dim == 2 else 200
    problem = scene.problem(options={**OPTIONS, "subdomain_size": size})
    return scene, problem, problem.solve()


def local_nodes(scene):
    index_map = scene.V.dofmap.index_map
    return np.arange(index_map.size_local + index_map.num_ghosts)


def keys(scene, nodes):
    """Return place and body of nodes of this rank, which tell them apart where bodies touch."""
    body = np.zeros(local_nodes(scene).size, dtype=int)
    if scene.cell_tags is not None:  # bodies share no node
        for cell, tag in zip(scene.cell_tags.indices, scene.cell_tags.values, strict=True):
            body[scene.V.dofmap.cell_dofs(int(cell))] = tag
    places = np.round(scene.V.tabulate_dof_coordinates()[nodes], 6) + 0.0
    return [(*place, tag) for place, tag in zip(places, body[nodes], strict=True)]


def assert_displacement(scene, uh, alone, reference):
    """Compare the displacement of all nodes, with ghosts, with that of one rank."""
    expected = reference.displacement.reshape(-1, scene.mesh.geometry.dim)
    row = {key: k for k, key in enumerate(keys(alone, local_nodes(alone)))}
    rows = [row[key] for key in keys(scene, local_nodes(scene))]
    error = uh.x.array.reshape(expected[rows].shape) - expected[rows]
    squares = COMM.allreduce(np.sum(error**2))
    assert np.sqrt(squares) <= 1e-6 * np.linalg.norm(expected), "displacement"


def assert_contacts(scene, problem, alone, serial, reference):
    """Compare gaps, normals, forces and pressures at each node, and the total forces."""
    first, last = scene.V.dofmap.index_map.local_range
    largest = max([contact.forces.max() for contact in reference.contacts] + [1e-3])
    assert len(problem.results) == len(scene.contacts)
    for found, expected, one in zip(
        problem.results, reference.contacts, serial.results, strict=True
    ):
        # each node is on the rank that owns it
        assert np.all((found.nodes >= first) & (found.nodes < last))
        everywhere = np.concatenate(COMM.allgather(found.nodes))
        assert np.unique(everywhere).size == everywhere.size == expected.nodes.size
        row = {key: k for k, key in enumerate(keys(alone, expected.nodes))}
        rows = [row[key] for key in keys(scene, found.dofs)]
        for name in ("coordinates", "gap", "normal"):
            values = getattr(expected, name)[rows]
            assert getattr(found, name).shape == values.shape
            np.testing.assert_allclose(getattr(found, name), values, atol=1e-12, err_msg=name)
        pressure = one.pressure[np.argsort(one.nodes)]
        for name, values, scale in (
            ("nodal_normal_force", expected.forces, largest),
            ("pressure", pressure, pressure.max() + 1e-3),
        ):
            np.testing.assert_allclose(
                getattr(found, name), values[rows], rtol=0.0, atol=1e-5 * scale, err_msg=name
            )
        np.testing.assert_array_equal(found.active, found.nodal_normal_force > 0.0)
    exact = scene.total_forces or [contact.forces.sum() for contact in reference.contacts]
    summed = [COMM.allreduce(contact.nodal_normal_force.sum()) for contact in problem.results]
    for name, total in (("report", normal_forces(problem)), ("sum over nodes", summed)):
        np.testing.assert_allclose(total, exact, rtol=1e-6, atol=1e-3, err_msg=name)


def assert_report(report, reference):
    """Sizes, energy and certificate, the same on all ranks."""
    assert report.converged and report.ranks == COMM.size
    for quantity, number in report.certificate.numbers().items():
        assert 0.0 <= number <= 1e-8, quantity
    assert report.subdomains >= 2
    assert report.unknowns["torn"] > report.unknowns["primal"] == reference.displacement.size
    # abs: rounding of the reference, where a block is moved without strains
    assert report.energy == pytest.approx(reference.energy, rel=1e-8, abs=1e-8)
    mine = (
        report.converged,
        report.reason,
        report.energy,
        tuple([c.normal_force for c in report.contacts]),
    )
    assert len(set(COMM.allgather(mine))) == 1


def assert_near(uh, displacement, factor=1e-6):
    error = np.linalg.norm(uh.x.array - displacement)
    assert error <= factor * np.linalg.norm(displacement), "displacement"


@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(n, marks=[pytest.mark.ranks] if n in ON_RANKS else []) for n in SMALL),
        *(pytest.param(n, marks=pytest.mark.heavy) for n in LARGE),
    ],
)
def test_scene(name):
    scene, problem, uh = solved(name, alone=COMM.size == 1)
    alone, serial = (scene, problem) if COMM.size == 1 else solved(name)[:2]
    reference = alone.reference()
    assert_displacement(scene, uh, alone, reference)
    assert_contacts(scene, problem, alone, serial, reference)
    assert_report(problem.report, reference)
    if name in ("beams, hexahedra", "ball, hexahedra", "materials, triangles"):
        # otherwise the inequalities might as well be equations
        forces = reference.contacts[0].forces
        assert 0 < np.count_nonzero(forces) < forces.size


@pytest.mark.ranks(2)
def test_some_pairs_are_of_nodes_on_different_ranks():
    """Otherwise the test above tests less than it says."""
    scene = SMALL["beams, quadrilaterals"](COMM)
    owner = {}
    for tag in (SLAVE, MASTER):
        nodes = nodes_of(scene.V, scene.facet_tags.find(tag))
        owned = nodes[nodes < scene.V.dofmap.index_map.size_local]
        for rank, part in enumerate(COMM.allgather(keys(scene, owned))):
            for key in part:
                owner.setdefault(key[:3], {})[tag] = rank
    assert any(len(set(ranks.values())) == 2 for ranks in owner.values())


@pytest.mark.parametrize("name", [name for name in SMALL if name.startswith("block")])
def test_uniform_stress_is_exact(name):
    """The area of the tagged surface is 1, so the total force is the pressure."""
    scene, problem, uh = solved(name)
    exact = scene.exact(scene.V.tabulate_dof_coordinates().T).T.ravel()
    np.testing.assert_allclose(uh.x.array, exact, rtol=0.0, atol=1e-6 * np.abs(exact).max())
    (total,) = scene.total_forces
    np.testing.assert_allclose(problem.results[0].pressure, total, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize(
    "options",
    [
        {"preconditioner": "dirichlet"},
        {"mprgp_expansion": "standard"},
        {"factor": "mumps"},
        {"smalbe_rho": 3.0},
        {"smalbe_M0": 100.0, "smalbe_eta": 1.0},
        {"subdomain_size": 100_000},
    ],
    ids=lambda options: ", ".join(f"{name}={value}" for name, value in options.items()),
)
def test_options_change_the_way_but_not_the_solution(options):
    scene = SMALL["materials, triangles"](MPI.COMM_SELF)
    uh = scene.problem(options={**OPTIONS, **options}).solve()
    assert_near(uh, scene.reference().displacement)


@pytest.mark.parametrize("rtol", [1e-2, 1e-6, 1e-10])
def test_tolerance_means_what_it_says(rtol):
    """The error follows rtol, with the condition of the problem for a factor."""
    scene = two_beams(MPI.COMM_SELF, "quadrilateral", 6)
    uh = scene.problem(options={**OPTIONS, "rtol": rtol}).solve()
    assert_near(uh, scene.reference().displacement, 30.0 * rtol)


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


def test_node_that_is_prescribed_where_it_touches():
    """The rows say nothing new there, and rounding must not make them a contradiction."""
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral", 6)
    scene.fix(GROUND, 1)
    problem = scene.problem(options=OPTIONS)
    exact = scene.exact(scene.V.tabulate_dof_coordinates().T).T.ravel()
    np.testing.assert_allclose(problem.solve().x.array, exact, rtol=0.0, atol=1e-9)


def test_node_that_sticks():
    """A prescribed tangential component leaves the normal one to the contact."""
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral", 6)
    scene.fix(GROUND, 0)
    assert_near(scene.problem(options=OPTIONS).solve(), scene.reference().displacement)


def test_body_that_may_slide_is_solved_and_reported():
    """Without the roller nothing holds the upper beam sideways, but nothing pushes it either."""
    scene = two_beams(MPI.COMM_SELF, "quadrilateral", 6)
    problem = scene.problem(bcs=scene.bcs[:1], options=OPTIONS)
    problem.solve()
    (motion,) = problem.report.free_motions
    assert "translation along (1, 0)" in motion
    np.testing.assert_allclose(normal_forces(problem), scene.total_forces, rtol=1e-6)


@pytest.mark.once
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
    scene = two_beams(MPI.COMM_SELF, "quadrilateral", 6)
    uh = scene.problem(options=OPTIONS, **arguments).solve()
    assert_near(uh, scene.reference().displacement)
