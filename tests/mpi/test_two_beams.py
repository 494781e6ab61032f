"""The same solution on any number of ranks."""

from __future__ import annotations

from functools import lru_cache

from mpi4py import MPI

import numpy as np
import pytest
from scenes import MASTER, SLAVE, Scene, pressed_block, stack_on_ground, two_beams, two_materials

comm = MPI.COMM_WORLD
OPTIONS = {"rtol": 1e-8, "subdomain_size": 200}

SCENES = {
    "beams, quadrilaterals": lambda comm: two_beams(comm, "quadrilateral", 6),
    "beams, hexahedra": lambda comm: two_beams(comm, "hexahedron", 4),
    "beams, tetrahedra": lambda comm: two_beams(comm, "tetrahedron", 3),
    "materials, triangles": lambda comm: two_materials(comm, "triangle", 6),
    "materials, hexahedra": lambda comm: two_materials(comm, "hexahedron", 3),
    "block, hexahedra": lambda comm: pressed_block(comm, "hexahedron", 4, gap=4e-4),
    "stack, quadrilaterals": lambda comm: stack_on_ground(comm, "quadrilateral", 8),
}
every_scene = pytest.mark.parametrize("name", SCENES)


@lru_cache(maxsize=None)
def solved(name: str):
    """Return scene, solved problem and displacement on all ranks, scene and reference on one."""
    scene, alone = SCENES[name](comm), SCENES[name](MPI.COMM_SELF)
    problem = scene.problem(options=OPTIONS)
    return scene, problem, problem.solve(), alone, alone.reference()


def bodies_of_nodes(scene: Scene) -> np.ndarray:
    """Return for each node on this rank the tag of its cells; bodies share no node."""
    index_map = scene.V.dofmap.index_map
    body = np.zeros(index_map.size_local + index_map.num_ghosts, dtype=int)
    if scene.cell_tags is not None:
        for cell, tag in zip(scene.cell_tags.indices, scene.cell_tags.values, strict=True):
            body[scene.V.dofmap.cell_dofs(int(cell))] = tag
    return body


def keys(scene: Scene, nodes) -> list[tuple]:
    """Return place and body of nodes, which tell them apart where bodies touch."""
    places = np.round(scene.V.tabulate_dof_coordinates()[nodes], 6) + 0.0
    return [(*place, tag) for place, tag in zip(places, bodies_of_nodes(scene)[nodes], strict=True)]


def all_nodes(scene: Scene) -> np.ndarray:
    index_map = scene.V.dofmap.index_map
    return np.arange(index_map.size_local + index_map.num_ghosts)


@every_scene
def test_displacement_with_ghosts(name):
    scene, _, uh, alone, reference = solved(name)
    gdim = scene.mesh.geometry.dim
    expected = dict(
        zip(keys(alone, all_nodes(alone)), reference.displacement.reshape(-1, gdim), strict=True)
    )
    nodes = all_nodes(scene)
    found = uh.x.array.reshape(-1, gdim)
    largest = np.abs(reference.displacement).max()
    for key, displacement in zip(keys(scene, nodes), found, strict=True):
        np.testing.assert_allclose(displacement, expected[key], rtol=0.0, atol=1e-6 * largest)


@every_scene
def test_contact_forces(name):
    scene, problem, _, alone, reference = solved(name)
    largest = max(contact.forces.max() for contact in reference.contacts)
    for found, expected in zip(problem.results, reference.contacts, strict=True):
        force = dict(zip(keys(alone, expected.nodes), expected.forces, strict=True))
        here = keys(scene, found.dofs)
        np.testing.assert_allclose(
            found.normal_force, [force[key] for key in here], rtol=0.0, atol=1e-5 * largest
        )


@every_scene
def test_each_slave_node_is_on_the_rank_that_owns_it(name):
    scene, problem, _, _, reference = solved(name)
    first, last = scene.V.dofmap.index_map.local_range
    for found, expected in zip(problem.results, reference.contacts, strict=True):
        assert np.all((found.nodes >= first) & (found.nodes < last))
        everywhere = np.concatenate(comm.allgather(found.nodes))
        assert np.unique(everywhere).size == everywhere.size == expected.nodes.size


@every_scene
def test_shapes_even_where_a_rank_has_no_slave_node(name):
    scene, problem, _, _, _ = solved(name)
    gdim = scene.mesh.geometry.dim
    for contact in problem.results:
        k = contact.nodes.size
        assert contact.coordinates.shape == (k, 3)
        assert contact.normal.shape == (k, gdim)
        for values in (contact.gap, contact.normal_force, contact.pressure, contact.active):
            assert values.shape == (k,)


@every_scene
def test_total_force(name):
    scene, problem, _, _, _ = solved(name)
    np.testing.assert_allclose(
        [c.normal_force for c in problem.report.contacts], scene.total_forces, rtol=1e-6
    )
    summed = [comm.allreduce(contact.normal_force.sum()) for contact in problem.results]
    np.testing.assert_allclose(summed, scene.total_forces, rtol=1e-6)


@every_scene
def test_pressure_is_that_of_one_process(name):
    """The area around a node is made of facets of several ranks."""
    scene, problem, _, alone, _ = solved(name)
    serial = alone.problem(options=OPTIONS)
    serial.solve()
    for found, expected in zip(problem.results, serial.results, strict=True):
        pressure = dict(zip(keys(alone, expected.nodes), expected.pressure, strict=True))
        largest = expected.pressure.max()
        np.testing.assert_allclose(
            found.pressure,
            [pressure[key] for key in keys(scene, found.dofs)],
            rtol=0.0,
            atol=1e-5 * largest,
        )


@every_scene
def test_report_is_the_same_on_all_ranks(name):
    _, problem, _, _, reference = solved(name)
    report = problem.report
    mine = (
        report.converged,
        report.reason,
        report.energy,
        tuple([c.normal_force for c in report.contacts]),
    )
    assert len(set(comm.allgather(mine))) == 1
    assert report.ranks == comm.size
    assert report.unknowns["primal"] == reference.displacement.size
    assert report.energy == pytest.approx(reference.energy, rel=1e-8)


@pytest.mark.skipif(comm.size == 1, reason="needs two ranks")
def test_some_pairs_are_of_nodes_on_different_ranks():
    """Otherwise this file tests less than it says."""
    scene = solved("beams, quadrilaterals")[0]
    owner: dict[tuple, dict[int, int]] = {}
    from primal_reference import nodes_of

    for tag in (SLAVE, MASTER):
        nodes = nodes_of(scene.V, scene.facet_tags.find(tag))
        owned = nodes[nodes < scene.V.dofmap.index_map.size_local]
        for key in [key for part in comm.allgather(keys(scene, owned)) for key in part]:
            owner.setdefault(key[:3], {})
        for rank, part in enumerate(comm.allgather(keys(scene, owned))):
            for key in part:
                owner[key[:3]][tag] = rank
    assert any(len(set(ranks.values())) == 2 for ranks in owner.values())
