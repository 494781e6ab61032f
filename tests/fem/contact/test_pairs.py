"""Conditions of many pairs that are found at once are those of each pair alone."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from matching import match_contacts

import ufl
from dolfinx import fem

from fenics_tfeti import Along, ContactPair, InputError, Mortar, find_contacts
from fenics_tfeti.fem.contact.conditions import surface_pairs as pairs_module
from fenics_tfeti.fem.contact.conditions.checks import check_opposite
from fenics_tfeti.fem.contact.conditions.deformed import deformed_contacts
from fenics_tfeti.fem.contact.search.contact_search import match_parts
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.nodes import ContactNodes, NodeMap
from fenics_tfeti.feti.system import Prescribed
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

pytestmark = pytest.mark.ranks(1, 2, 3)

COMM = MPI.COMM_WORLD
SLABS = [(3, 2), (3, 2), (4, 2), (2, 3), (2, 2)]  # divisions; only the first two meshes match


def pile(cell, degree=1):
    """Return the space and the pairs of slabs on each other, each beside a shorter one."""
    gdim = 2 if cell in ("triangle", "quadrilateral") else 3
    bodies = []
    for k, (along, up) in enumerate(SLABS):
        middle = [2] * (gdim - 2)
        lower, upper = [0.0] * (gdim - 1), [1.0] * (gdim - 1)
        bodies.append(Box((*lower, k), (*upper, k + 1), (along, *middle, up)))
        bodies.append(Box((1.2, *lower[1:], k), (1.9, *upper[1:], k + 1), (2, *middle, 2 + k % 2)))
    made = boxes(COMM, bodies, cell)
    space = displacement_space(made.mesh, degree)
    return space, find_contacts(made.mesh, made.cell_tags, distance=0.1)


def rings():
    """Return the space and the pairs of a quarter of two rings with a lid; inner nodes shifted."""
    bodies = [
        Box((1, 0, 0), (2, 1.5, 1), (2, 6, 5)),
        Box((2, 0, 0), (3, 1.5, 1), (2, 5, 4)),
        Box((1, 0, 1), (3, 1.5, 2), (3, 4, 1)),
    ]
    made = boxes(COMM, bodies, "tetrahedron")
    x = made.mesh.geometry.x
    r, angle, z = x.T.copy()
    z += 0.05 * np.sin(9 * angle) * np.sin(np.pi * z)
    x[:] = np.column_stack([r * np.cos(angle), r * np.sin(angle), z])
    return displacement_space(made.mesh), find_contacts(made.mesh, made.cell_tags, distance=0.3)


def supports(space):
    """Return a plane of symmetry at x = 0."""
    nodes = NodeMap(space)
    held = np.flatnonzero(np.isclose(nodes.coordinates[:, 0], 0.0))
    zeros = np.zeros(held.size)
    return Prescribed(nodes.first + held, np.zeros(held.size, dtype=np.int64), zeros)


def assert_alike(found, alone):
    """Compare conditions with those that were found for one pair."""
    assert found.name == alone.name
    for entry, value in alone.summary.items():
        is_text = value is None or isinstance(value, str)
        expected = value if is_text else pytest.approx(value, rel=1e-9, abs=1e-12)
        assert found.summary[entry] == expected, entry
    np.testing.assert_array_equal(found.slave, alone.slave)
    np.testing.assert_array_equal(found.terms.nodes, alone.terms.nodes)
    np.testing.assert_array_equal(found.terms.offsets, alone.terms.offsets)
    np.testing.assert_array_equal(found.terms.slaves, alone.terms.slaves)
    np.testing.assert_array_equal(found.covered, alone.covered)
    for name in ("normal", "gap", "area", "coverage"):
        values = (getattr(found, name), getattr(alone, name))
        np.testing.assert_allclose(*values, rtol=1e-12, atol=1e-14, err_msg=name)
    np.testing.assert_allclose(found.terms.weights, alone.terms.weights, atol=1e-14)
    for surface, other in zip(found.surfaces, alone.surfaces, strict=True):
        for name in ("nodes", "normal", "area", "size", "facet_nodes", "extent"):
            values = (getattr(surface, name), getattr(other, name))
            np.testing.assert_allclose(*values, rtol=1e-14, atol=1e-16, err_msg=name)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(
    ("cell", "degree"),
    [("quadrilateral", 1), ("triangle", 2), ("hexahedron", 1), ("tetrahedron", 2)],
)
def test_pile(cell, degree, weighted):
    """Of some joints the meshes match; one has partners of its own, and one a gap of its own."""
    space, pairs = pile(cell, degree)
    pairs[1] = replace(pairs[1], initial_gap=1e-3)
    pairs[2] = replace(pairs[2], partners=Mortar())
    if degree == 1:
        pairs[3] = replace(
            pairs[3], partners=Along(np.eye(space.mesh.geometry.dim)[-1]), partial=True
        )
    weight = 1.0 + ufl.SpatialCoordinate(space.mesh)[0] if weighted else None
    boundary, held = MeshBoundary.of(space, weight), supports(space)
    found = match_contacts(boundary, pairs, prescribed=held)
    assert len(found) == 8
    kinds = {conditions.summary["discretisation"] for conditions in found}
    assert kinds == ({"mortar", "node_to_node"} if degree == 1 else {"mortar"})
    for pair, conditions in zip(pairs, found, strict=True):
        assert_alike(conditions, match_contacts(boundary, [pair], prescribed=held)[0])


def moved(space):
    """Return a displacement that bends and parts the bodies."""
    uh = fem.Function(space)
    gdim = space.mesh.geometry.dim

    def bend(x):
        height = x[gdim - 1]
        return np.stack([0.02 * np.sin(height + k + 2.0 * x[k]) for k in range(gdim)])

    uh.interpolate(bend)
    return uh


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(
    ("cell", "degree"), [("triangle", 1), ("quadrilateral", 2), ("tetrahedron", 1)]
)
def test_pile_that_has_moved(cell, degree, weighted):
    """One pair has normals of its own, which turn with its facets."""
    space, pairs = pile(cell, degree)
    up = np.eye(space.mesh.geometry.dim)[-1]
    upwards = find_normal(match_contacts(MeshBoundary.of(space), pairs[2:3])[0], up)
    pairs[2] = replace(pairs[2], partners=Mortar(), normal=upwards)
    weight = 1.0 + ufl.SpatialCoordinate(space.mesh)[0] if weighted else None
    boundary, uh = MeshBoundary.of(space, weight), moved(space)
    known = [*zip(pairs, match_contacts(boundary, pairs, prescribed=supports(space)), strict=True)]
    for one, new in zip(known, deformed_contacts(known, uh), strict=True):
        (alone,) = deformed_contacts([one], uh)
        assert_alike(new.conditions, alone.conditions)
        force = np.arange(1.0, 1.0 + new.conditions.slave.size)
        tractions = [x.conditions.mean_traction(force) for x in (new, alone)]
        np.testing.assert_allclose(*tractions, rtol=1e-12)


def find_normal(conditions, up):
    """Return the direction along an axis that points out of a slave."""
    along = COMM.allreduce(float(np.sum(conditions.normal @ up)))
    return np.sign(along) * up


def test_round_and_flat_surfaces():
    """Normals of the round pair have no part along the axis, those of flat ones no other."""
    space, pairs = rings()
    boundary = MeshBoundary.of(space)
    found = match_contacts(boundary, pairs)
    across = [np.abs(conditions.normal[:, 2]).max(initial=0.0) for conditions in found]
    assert COMM.allreduce(across[0], MPI.MAX) < 1e-13
    alone = [part for pair in pairs for part in match_contacts(boundary, [pair])]
    for conditions, part in zip(found, alone, strict=True):
        assert_alike(conditions, part)


def test_work_is_done_once_for_all_pairs(monkeypatch):
    """Neither integrals nor exchanges are those of single pairs."""
    space, pairs = pile("quadrilateral")
    calls, conditions = [], pairs_module.mortar_conditions
    monkeypatch.setattr(
        pairs_module, "mortar_conditions", lambda *args: calls.append(args) or conditions(*args)
    )
    found = match_contacts(MeshBoundary.of(space), pairs)
    assert sum(conditions.is_mortar for conditions in found) > 1
    assert len(calls) == 1
    deformed_contacts([*zip(pairs, found, strict=True)], fem.Function(space))
    assert len(calls) == 2


def test_errors_name_the_first_pair_that_is_wrong():
    """Two pairs of surfaces that look the same way, among others."""
    space, pairs = pile("quadrilateral")
    boundary, mesh = MeshBoundary.of(space), space.mesh
    ends = [(7, lambda x: np.isclose(x[0], 0.0)), (8, lambda x: np.isclose(x[0], 1.2))]
    tags = tag_facets(mesh, ends)
    pairs[5:5] = [ContactPair(tags, 7, 8, name="wrong")]
    pairs[7:7] = [ContactPair(tag_facets(mesh, ends), 8, 7, name="wrong, too")]
    with pytest.raises(InputError, match="^wrong: no facet of the slave"):
        check_opposite(match_parts(boundary, pairs))
    pairs[5] = ContactPair(tags, 7, 9, name="untagged")
    with pytest.raises(InputError, match="^master of untagged: tag 9 is on no facet"):
        match_contacts(boundary, pairs)


def test_nodes_of_contacts():
    """Each node is there once in each contact, at its owner, wherever its facets are."""
    space, _ = pile("hexahedron")
    nodes = NodeMap(space)
    local = np.arange(nodes.size, dtype=np.int32)
    facets = local[: 4 * (local.size // 4)].reshape(-1, 4)
    contact = np.arange(len(facets)) % 3
    copies = ContactNodes(nodes, facets, contact)
    assert copies.total == COMM.allreduce(copies.owned)
    numbers = copies.to_global(copies.facet_nodes)
    np.testing.assert_array_equal(copies.to_local(numbers.ravel()), copies.facet_nodes.ravel())
    np.testing.assert_array_equal(copies.originals[copies.facet_nodes], facets)
    np.testing.assert_array_equal(copies.contact[copies.facet_nodes].T, np.tile(contact, (4, 1)))
    own = nodes.to_global(copies.originals[: copies.owned]) * 3 + copies.contact[: copies.owned]
    expected = nodes.to_global(facets) * 3 + contact[:, None]
    np.testing.assert_array_equal(copies.values_at(own, numbers), expected)
    everything = np.unique(np.concatenate(COMM.allgather(expected.ravel())))
    assert copies.total == everything.size
