"""Bodies that share nodes get nodes of their own at the interfaces between them."""

from mpi4py import MPI

import numpy as np
import pytest
from joined_bodies import (
    GDIM,
    block,
    bolt_in_block,
    elasticity,
    halves,
    measure,
    middle,
    of_degree_two,
    thirds,
    vertices,
)
from scenes import integral

import ufl

from fenics_tfeti import ContactPair, ContactProblem, InputError, TiedPair
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.io import Interface, read_msh, split_interfaces

COMM = MPI.COMM_SELF


@pytest.mark.parametrize("cell", GDIM)
def test_each_facet_of_the_interface_is_there_twice(cell):
    before = block(cell, halves)
    after = split_interfaces(before, [Interface((1, 2), (5, 6))])
    assert vertices(after) == vertices(before) + 5 ** (GDIM[cell] - 1)
    sizes = [measure(after, "ds", tag) for tag in (5, 6, 7)]
    assert sizes == pytest.approx([1.0, 1.0, 1.0])
    assert [measure(after, "dx", tag) for tag in (1, 2)] == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_tags_are_on_the_sides_of_their_bodies(cell):
    after = split_interfaces(block(cell, halves), [Interface((2, 1), (5, 6))])
    normal = ufl.FacetNormal(after.mesh)
    along = [integral(after.mesh, after.facet_tags, t, "ds", normal[0]) for t in (5, 6)]
    assert along == pytest.approx([-1.0, 1.0])


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_three_bodies_come_apart_where_they_meet(cell):
    before = block(cell, thirds)
    layers = 5 ** (GDIM[cell] - 2)
    every = [Interface((1, 2), (11, 12)), Interface((1, 3), (11, 13)), Interface((2, 3), (14, 15))]
    after = split_interfaces(before, every)
    # two sides of three and seven nodes of two, two copies more in the middle
    assert vertices(after) == vertices(before) + layers * (4 + 2 + 2)
    assert [measure(after, "ds", t) for t in range(11, 16)] == pytest.approx(
        [1, 0.5, 0.5, 0.5, 0.5]
    )


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_bodies_stay_together_through_a_third_one(cell):
    before = block(cell, thirds)
    layers = 5 ** (GDIM[cell] - 2)
    after = split_interfaces(before, [Interface((2, 3), (11, 12))])
    # the nodes where all three meet are the tip
    assert vertices(after) == vertices(before) + 2 * layers


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_nodes_at_the_tip_of_a_partial_interface_stay(cell):
    before = block(cell, halves, tagged=lambda x: middle(x) & (x[:, 1] < 0.5))
    after = split_interfaces(before, [Interface((1, 2), (5, 6), facets=9)])
    assert vertices(after) == vertices(before) + 2 * 5 ** (GDIM[cell] - 2)
    assert measure(after, "ds", 5) == pytest.approx(0.5)
    assert after.facet_tags.find(9).size == 0


def test_facets_of_the_tag_elsewhere_keep_it():
    before = block("triangle", thirds, tagged=lambda x: middle(x) | np.isclose(x[:, 1], 0.0))
    after = split_interfaces(before, [Interface((1, 2), (5, 6), facets=9)])
    assert measure(after, "ds", 9) == pytest.approx(1.0)
    assert measure(after, "dS", 9) == pytest.approx(0.5)
    assert measure(after, "ds", 5) == pytest.approx(0.5)


def test_new_names_get_new_tags():
    after = split_interfaces(block("triangle", halves), [Interface((1, 2), ("left", "right"))])
    assert after.names == {"side": 7, "left": 8, "right": 9}
    assert measure(after, "ds", after.names["right"]) == pytest.approx(1.0)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_cut_through_a_body(cell):
    """The slave is below the plane; facets with the tag on the boundary keep it."""
    before = block(cell, whole, tagged=lambda x: middle(x) | np.isclose(x[:, 0], 0.0))
    after = split_interfaces(before, [Interface((1, 1), (5, 6), facets=9)])
    assert vertices(after) == vertices(before) + 5 ** (GDIM[cell] - 1)
    normal = ufl.FacetNormal(after.mesh)
    along = [integral(after.mesh, after.facet_tags, t, "ds", normal[0]) for t in (5, 6, 9)]
    assert along == pytest.approx([1.0, -1.0, -1.0])


def test_cut_along_two_planes():
    before = block("triangle", whole, tagged=lambda x: middle(x) | np.isclose(x[:, 1], 0.5))
    with pytest.raises(InputError, match=r"\d of the facets with tag 9 .* far from the plane"):
        split_interfaces(before, [Interface((1, 1), (5, 6), facets=9)])


def whole(x):
    """Return one tag for all cells."""
    return np.ones(len(x), dtype=np.int64)


@pytest.mark.parametrize(
    ("interfaces", "message"),
    [
        ([Interface(("bolt", 2), (5, 6))], r"no body .* name 'bolt'; the names are \['side'\]"),
        ([Interface((4, 2), (5, 6))], r"tag 4 is on no cell; the cell tags are \[1, 2, 3\]"),
        ([Interface((1, 2), (5, 6), facets=8)], r"tag 8 is on no facet; the facet tags are \[7\]"),
        (
            [Interface((1, 2), (5, 6), facets="side")],
            "no facets with tag 7 between the bodies 1 and 2",
        ),
        ([Interface((1, 1), (5, 6))], "both are the same body"),
        ([Interface((1, 2), (5, 5))], "the two new surfaces have the same tag"),
        ([Interface((1, 2), (7, 6))], r"other facets have the tags \[7\]"),
        ([Interface((1, 2), ("side", 6))], "'side' has the name of a body or surface"),
        (
            [Interface((1, 2), (5, 6)), Interface((2, 1), (8, 9))],
            "8 of the facets .* in two interfaces",
        ),
    ],
)
def test_wrong_input_is_named(interfaces, message):
    n = 8
    with pytest.raises(InputError, match=message):
        if len(interfaces) > 1:
            split_interfaces(block("triangle", halves, n=n), interfaces)
        split_interfaces(block("triangle", thirds, n=n), interfaces)


def test_surface_that_is_all_tip_is_an_error():
    before = block("triangle", halves, tagged=lambda x: middle(x) & (np.abs(x[:, 1] - 0.4) < 0.1))
    with pytest.raises(InputError, match=r"1 facets .* first around \(0.5, 0.375\)"):
        split_interfaces(before, [Interface((1, 2), (5, 6), facets=9)])


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_contact_after_the_split(cell):
    parts = split_interfaces(block(cell, halves), [Interface((1, 2), (5, 6))])
    a, L, bcs = elasticity(parts, 1e-3)
    contact = ContactPair(parts.facet_tags, 5, 6)
    problem = ContactProblem(a, L, bcs=bcs, contacts=[contact], options={"rtol": 1e-10})
    uh = problem.solve()
    assert problem.results[0].pressure == pytest.approx(1e-3, rel=1e-8)
    gdim = GDIM[cell]
    x = uh.function_space.tabulate_dof_coordinates()
    assert uh.x.array.reshape(-1, gdim)[:, 0] == pytest.approx(-1e-3 * x[:, 0], abs=1e-11)


@pytest.mark.parametrize("kind", [ContactPair, TiedPair])
def test_interior_facets_are_named_with_place_and_remedy(kind):
    whole = block("triangle", halves, tagged=middle)
    a, L, bcs = elasticity(whole, 1.0)
    pairs = [kind(whole.facet_tags, 9, 7, name="joint")]
    message = r"slave of joint: 4 of the 4 .* around \(0.5, 0.125\).*split_interfaces"
    with pytest.raises(InputError, match=message):
        ContactProblem(a, L, bcs=bcs, contacts=pairs).solve()


@pytest.mark.parametrize("kind", [ContactPair, TiedPair])
def test_shared_nodes_are_named_with_place_and_remedy(kind):
    before = block("triangle", halves, tagged=lambda x: middle(x) & (x[:, 1] < 0.5))
    parts = split_interfaces(before, [Interface((1, 2), (5, 6), facets=9)])
    a, L, bcs = elasticity(parts, 1.0)
    pairs = [kind(parts.facet_tags, 5, 6, name="joint")]
    message = r"joint: slave and master share 1 nodes, the first at \(0.5, 0.5\).*split_interfaces"
    with pytest.raises(InputError, match=message):
        ContactProblem(a, L, bcs=bcs, contacts=pairs, cell_tags=parts.cell_tags).solve()


# -- meshes of Gmsh ----------------------------------------------------------------------------


@pytest.mark.parametrize(("gdim", "order"), [(2, 1), (3, 2)])
def test_fragments_of_gmsh_come_apart(tmp_path, gdim, order):
    path = tmp_path / "bolt.msh"
    bolt_in_block(path, gdim, order)
    before = read_msh(path, COMM, gdim)
    shank = Interface(("bolt", "block"), ("shank", "wall"), facets="hole")
    after = read_msh(path, COMM, gdim, split=[shank])
    rough = {1: 0.03, 2: 1e-3}[order]
    for name in ("shank", "wall"):
        assert measure(after, "ds", after.names[name]) == pytest.approx(1.4 * np.pi, rel=rough)
    names = find_bodies(after.mesh, after.cell_tags).names
    assert {name.split(" ")[2] for name in names} == {"(bolt)", "(block)"}
    for kind, name in (("dx", "bolt"), ("dx", "block"), ("ds", "outside")):
        tag = before.names[name]
        assert measure(after, kind, tag) == pytest.approx(measure(before, kind, tag), rel=1e-12)
    topology, hole = before.mesh.topology, before.facet_tags.find(before.names["hole"])
    topology.create_connectivity(gdim - 1, 0)
    shared = {int(v) for f in hole for v in topology.connectivity(gdim - 1, 0).links(f)}
    assert vertices(after) == vertices(before) + len(shared)


@pytest.mark.parametrize("cell", GDIM)
def test_nodes_of_degree_two_are_doubled_with_their_edges_and_faces(cell):
    before = of_degree_two(cell, halves)
    after = split_interfaces(before, [Interface((1, 2), (5, 6))])
    counts = [tagged.mesh.geometry.index_map().size_global for tagged in (before, after)]
    assert counts[0] == 9 ** GDIM[cell]
    assert counts[1] - counts[0] == 9 ** (GDIM[cell] - 1)
    assert measure(after, "dx", 1) == pytest.approx(0.5)


def test_degree_two_keeps_its_curved_sides(tmp_path):
    bolt_in_block(tmp_path / "bolt.msh", 2, 2)
    shank = Interface(("bolt", "block"), ("shank", "wall"))
    after = read_msh(tmp_path / "bolt.msh", COMM, 2, split=[shank])
    assert _compat.geometry_degree(after.mesh) == 2
    assert measure(after, "dx", after.names["bolt"]) == pytest.approx(np.pi * 0.49, rel=1e-3)
