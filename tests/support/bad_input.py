"""Problems that a user may pose by mistake, and what has to be said about each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import scenes
from mesh_arrays import grid, merged, mesh_of, problem_on, slit, tags_of, together
from scenes import CLAMPED, LOADED, MASTER, ROLLER, SLAVE, YOUNG

import ufl
from dolfinx import fem, mesh

from fenics_tfeti import ContactPair, ContactProblem, RigidObstacle, Sphere
from fenics_tfeti.errors import InputError, UnresistedMotion
from fenics_tfeti.io import Box, boxes, tag_facets


@dataclass(frozen=True)
class Mistake:
    """`pose` sets up and solves the problem on a communicator; the message matches all `words`."""

    name: str
    pose: Callable[[MPI.Comm], object]
    words: tuple[str, ...]
    error: type[Exception] = InputError


MISTAKES: list[Mistake] = []


def mistake(*words: str, error: type[Exception] = InputError):
    def register(pose: Callable[[MPI.Comm], object]) -> Callable[[MPI.Comm], object]:
        MISTAKES.append(Mistake(pose.__name__, pose, words, error))
        return pose

    return register


def beams(comm: MPI.Comm) -> scenes.Scene:
    return scenes.two_beams(comm, "quadrilateral", 4)


# -- contacts --------------------------------------------------------------------------------------


def non_matching(comm: MPI.Comm) -> scenes.Scene:
    """Two blocks with 4 and 3 elements along the contact: the two inner slave nodes miss."""
    tagged = boxes(
        comm, [Box((0, 0), (1, 1), (4, 4)), Box((0, 1), (1, 2), (3, 4))], "quadrilateral"
    )
    tags = tag_facets(
        tagged.mesh,
        [
            (CLAMPED, scenes.at(1, 0.0), 1),
            (ROLLER, scenes.at(1, 2.0), 2),
            (MASTER, scenes.at(1, 1.0), 1),
            (SLAVE, scenes.at(1, 1.0), 2),
        ],
        tagged.cell_tags,
    )
    V = scenes.vector_space(tagged.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young, load = fem.Constant(tagged.mesh, YOUNG), fem.Constant(tagged.mesh, 1.0)
    return scenes.Scene(
        mesh=tagged.mesh,
        V=V,
        a=scenes.elasticity(u, v, young),
        L=load * v[0] * ufl.dx,
        bcs=[scenes.fixed(V, tags, CLAMPED, None), scenes.fixed(V, tags, ROLLER, None)],
        contacts=[scenes.reference.Pair(SLAVE, MASTER)],
        facet_tags=tags,
        cell_tags=tagged.cell_tags,
        total_forces=[],
        kept=[young, load],
    )


@mistake(r"\b2 (of 4 )?slave nodes", r"0\.333|0\.666", r"distance|away", r"0\.08|8\.3", "toleran")
def slave_nodes_without_partner(comm):
    non_matching(comm).problem().solve()


@mistake("99", "facet")
def slave_tag_on_no_facet(comm):
    scene = beams(comm)
    scene.problem(contacts=[ContactPair(scene.facet_tags, slave=99, master=MASTER)]).solve()


@mistake("98", "facet")
def master_tag_on_no_facet(comm):
    scene = beams(comm)
    scene.problem(contacts=[ContactPair(scene.facet_tags, slave=SLAVE, master=98)]).solve()


@mistake("97", "facet")
def obstacle_tag_on_no_facet(comm):
    scene = beams(comm)
    ground = scenes.Plane((0.0, 0.0), (0.0, 1.0))
    scene.problem(contacts=[RigidObstacle(scene.facet_tags, slave=97, obstacle=ground)]).solve()


@mistake("slave", "master", r"\b5\b")
def slave_is_its_own_master(comm):
    scene = beams(comm)
    scene.problem(contacts=[ContactPair(scene.facet_tags, slave=SLAVE, master=SLAVE)]).solve()


@mistake("slave", "master")
def slave_of_one_contact_is_master_of_another(comm):
    scene = beams(comm)
    tags = scene.facet_tags
    pairs = [ContactPair(tags, slave=SLAVE, master=MASTER)]
    scene.problem(contacts=[*pairs, ContactPair(tags, slave=MASTER, master=SLAVE)]).solve()


@mistake("facet", "cell|dimension")
def cell_tags_for_facet_tags(comm):
    scene = beams(comm)
    scene.problem(contacts=[ContactPair(scene.cell_tags, slave=1, master=2)]).solve()


@mistake("mesh")
def facet_tags_of_another_mesh(comm):
    scene, other = beams(comm), beams(comm)
    contacts = [ContactPair(other.facet_tags, slave=SLAVE, master=MASTER)]
    scene.problem(contacts=contacts).solve()


@mistake("obstacle", "(?i)nan|finite")
def obstacle_returns_nan(comm):
    scene = beams(comm)

    def ground(x):
        return np.full(x.shape[1], np.nan), np.tile([[0.0], [1.0]], x.shape[1])

    contacts = [RigidObstacle(scene.facet_tags, slave=SLAVE, obstacle=ground)]
    scene.problem(contacts=contacts).solve()


@mistake("obstacle", "shape")
def obstacle_returns_a_wrong_shape(comm):
    scene = beams(comm)

    def ground(x):
        return 0.0, np.array([0.0, 1.0])

    contacts = [RigidObstacle(scene.facet_tags, slave=SLAVE, obstacle=ground)]
    scene.problem(contacts=contacts).solve()


@mistake("normal", "unit|length")
def obstacle_returns_normals_of_no_unit_length(comm):
    scene = beams(comm)

    def ground(x):
        return x[1], np.tile([[0.0], [2.0]], x.shape[1])

    contacts = [RigidObstacle(scene.facet_tags, slave=SLAVE, obstacle=ground)]
    scene.problem(contacts=contacts).solve()


@mistake("obstacle", "(?i)ZeroDivisionError", "shape")
def obstacle_that_fails(comm):
    scene = beams(comm)
    contacts = [RigidObstacle(scene.facet_tags, slave=SLAVE, obstacle=lambda x: 1 / 0)]
    scene.problem(contacts=contacts).solve()


@mistake("obstacle", r"\(gap, normal\)")
def obstacle_returns_nothing(comm):
    scene = beams(comm)
    contacts = [RigidObstacle(scene.facet_tags, slave=SLAVE, obstacle=lambda x: "far away")]
    scene.problem(contacts=contacts).solve()


@mistake("centre", r"\(1\.5, 1\)", "contact 0")
def slave_node_at_the_centre_of_the_sphere(comm):
    scene = beams(comm)
    contacts = [RigidObstacle(scene.facet_tags, slave=SLAVE, obstacle=Sphere((1.5, 1.0), 0.1))]
    scene.problem(contacts=contacts).solve()


@mistake("contact 0", "obstacle", "hollow=True", "turn it round", r"\b5\b")
def obstacle_on_the_wrong_side(comm):
    scene = beams(comm)
    plane = scenes.Plane((0.0, 1.0), (0.0, -1.0))
    contacts = [RigidObstacle(scene.facet_tags, slave=SLAVE, obstacle=plane)]
    scene.problem(contacts=contacts).solve()


# -- the pairing -----------------------------------------------------------------------------------

# the slave's nodes of beams()
PLACES = np.array([[1.0, 1.0, 0.0], [1.25, 1, 0], [1.5, 1, 0], [1.75, 1, 0], [2.0, 1, 0]])


def paired(comm: MPI.Comm, **arguments) -> None:
    scene = beams(comm)
    pair = ContactPair(scene.facet_tags, slave=SLAVE, master=MASTER, name="joint", **arguments)
    scene.problem(contacts=[pair]).solve()


@mistake("joint", "direction and mapping", "one way")
def two_ways_to_find_partners(comm):
    paired(comm, direction=(0.0, 1.0), mapping=lambda x: x)


@mistake("joint", "tolerance", "-0.1", "positive")
def tolerance_that_is_negative(comm):
    paired(comm, tolerance=-0.1)


@mistake("joint", "direction", r"\(3,\)", r"\(2,\)")
def direction_of_a_wrong_shape(comm):
    paired(comm, direction=(0.0, 0.0, 1.0))


@mistake("joint", "direction", "no direction")
def direction_of_no_length(comm):
    paired(comm, direction=(0.0, 0.0))


@mistake("joint", "direction", "vanishes", "1 points", r"\(1\.5, 1\)")
def direction_that_vanishes_somewhere(comm):
    paired(comm, direction=lambda x: x[:2] - np.array([[1.5], [1.0]]))


@mistake("joint", r"5 of 5 slave nodes have no partner", r"\(1, 1\.1\) at dist", "across the dir")
def direction_that_misses(comm):
    scene = scenes.two_beams(comm, "quadrilateral", 4, gap=0.1)
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, name="joint", direction=(1.0, -1.0))
    scene.problem(contacts=[pair]).solve()


@mistake("joint", "mapping", "function")
def mapping_that_is_no_function(comm):
    paired(comm, mapping=(0.0, 1.0))


@mistake("joint", "mapping", "shape", r"expected \(2, \d\)")
def mapping_of_a_wrong_shape(comm):
    paired(comm, mapping=lambda x: x[0])


@mistake("joint", "mapping", "NaN", "1 points", r"\(1\.25, 1\)")
def mapping_that_is_nan_somewhere(comm):
    paired(comm, mapping=lambda x: np.where(np.isclose(x[0], 1.25), np.nan, x))


@mistake("joint", "mapping", "KeyError", "chi")
def mapping_that_fails(comm):
    paired(comm, mapping=lambda x: {}["chi"])


@mistake("joint", r"4 of 5 slave nodes", r"\(1, 1\) at distance 0.125", "mapped", "0.5", "toleran")
def mapping_that_misses_the_nodes(comm):
    paired(comm, mapping=lambda x: x + np.array([[0.125], [0.0], [0.0]]) * (3 - 2 * x[0]))


@mistake("joint", "cross", "4 edges", r"\(1, 1\) and \(1\.25, 1\)", r"\(2, 1\) and \(1\.75, 1\)")
def mapping_that_turns_the_surface_round(comm):
    paired(comm, mapping=lambda x: np.array([3.0 - x[0], x[1], x[2]]))


@mistake("joint", "cross", r"1 edges", r"\(1\.25, 1\) and \(1\.5, 1\)", "opposite order")
def pairs_that_cross(comm):
    paired(comm, pairs=(PLACES, PLACES[[0, 2, 1, 3, 4]]))


@mistake("joint", "1 slave nodes", "several pairs", r"\(1\.25, 1\)", "once")
def slave_node_in_two_pairs(comm):
    paired(comm, pairs=(PLACES[[0, 1, 1, 2, 3, 4]], PLACES[[0, 1, 2, 2, 3, 4]]))


@mistake(
    "joint", "1 master nodes", "several slave nodes", r"\(1\.5, 1\) of those at \(1\.25, 1\) and"
)
def master_node_in_two_pairs(comm):
    paired(comm, pairs=(PLACES, PLACES[[0, 2, 2, 3, 4]]))


@mistake("joint", "1 of 5 slave nodes", r"\(1\.5, 1\)", "partial=True")
def slave_node_in_no_pair(comm):
    paired(comm, pairs=(PLACES[[0, 1, 3, 4]], PLACES[[0, 1, 3, 4]]))


@mistake("joint", "slave points", "1 pairs", r"\(1\.35, 1\) at distance 0.1 ", "0.025", "toleran")
def slave_points_of_pairs_that_are_no_nodes(comm):
    moved = PLACES + np.outer([0, 1, 0, 0, 0], [0.1, 0, 0])
    paired(comm, pairs=(moved, PLACES))


@mistake("joint", "master points", "5 pairs", r"\(1, 1\.5\) at distance 0.5 ", "toleran")
def master_points_of_pairs_that_are_no_nodes(comm):
    paired(comm, pairs=(PLACES, PLACES + [0.0, 0.5, 0.0]))


@mistake("joint", "pairs", "5 slave points", "4 master points")
def pairs_of_different_lengths(comm):
    paired(comm, pairs=(PLACES, PLACES[1:]))


@mistake("joint", "slave points of pairs", "NaN", "row 2")
def pairs_with_nan(comm):
    paired(comm, pairs=(np.where(PLACES == 1.5, np.nan, PLACES), PLACES))


@mistake("joint", "normal", "slave", "inwards|into the body", "5 nodes", r"\(1, 1\)")
def normal_that_points_inwards(comm):
    paired(comm, normal=(0.0, 1.0))


@mistake("joint", "normal", "along its surface", "1 nodes", r"\(1\.75, 1\)")
def normal_that_is_tangential_somewhere(comm):
    paired(comm, normal=lambda x: np.array([np.isclose(x[0], 1.75), -1.0 + np.isclose(x[0], 1.75)]))


@mistake("joint", "normal", "vanishes", "1 points", r"\(1, 1\)")
def normal_that_vanishes_somewhere(comm):
    paired(comm, normal=lambda x: np.array([0 * x[0], 1.0 - x[0]]))


@mistake("joint", "normal", r"\(3,\)", r"\(2,\)")
def normal_of_a_wrong_shape(comm):
    paired(comm, normal=(0.0, 0.0, 1.0))


@mistake("joint", "normal", "NaN", r"\(1\.5, 1\)")
def normal_that_is_nan_somewhere(comm):
    paired(
        comm, normal=lambda x: np.array([0 * x[0], np.where(np.isclose(x[0], 1.5), np.nan, -1.0)])
    )


@mistake("contact 0", "4 of 4 slave nodes", "toleran")
def partial_contact_without_any_pair(comm):
    scene = non_matching(comm)
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, mapping=lambda x: x + 5.0, partial=True)
    scene.problem(contacts=[pair]).solve()


@mistake(
    "contact 0", "1 master nodes", r"\(0.25, 1\) and \(0.5, 1\)", "one to one", "tolerance below"
)
def partial_contact_that_is_not_one_to_one(comm):
    """The master has 3 elements on the slave's 4."""
    scene = non_matching(comm)
    pair = ContactPair(scene.facet_tags, MASTER, SLAVE, tolerance=1.0, partial=True)
    scene.problem(contacts=[pair]).solve()


@mistake("one", "two", "1 slave nodes twice", r"\(1\.5, 1\)", "one tag")
def slave_nodes_with_the_same_master_in_two_contacts(comm):
    scene = beams(comm)
    halves = tag_facets(
        scene.mesh,
        [
            (SLAVE, lambda x: np.isclose(x[1], 1.0) & (x[0] > 0.99) & (x[0] < 1.51), 2),
            (MASTER, lambda x: np.isclose(x[1], 1.0) & (x[0] > 0.99) & (x[0] < 2.01), 1),
            (LOADED, lambda x: np.isclose(x[1], 1.0) & (x[0] > 1.49) & (x[0] < 2.01), 2),
        ],
        scene.cell_tags,
    )
    contacts = [
        ContactPair(halves, SLAVE, MASTER, name="one"),
        ContactPair(halves, LOADED, MASTER, name="two"),
    ]
    scene.problem(contacts=contacts).solve()


# -- meshes ----------------------------------------------------------------------------------------


@mistake("tag 7", "2 pieces", r"\(0\.5, 0\.5\)", r"\(5\.5, 0\.5\)", "cell_tags", "own")
def tag_on_two_pieces(comm):
    points, cells = together(grid((2, 2)), grid((2, 2), (5.0, 0.0)))
    domain = mesh_of(comm, "quadrilateral", points, cells)
    problem_on(domain, cell_tags=tags_of(domain, np.full(8, 7)))


@mistake("tag 7", "2 pieces", "3 pairs of nodes", "same place", r"\(2, 0\)", "merged")
def tag_on_two_pieces_with_nodes_at_the_same_places(comm):
    points, cells = together(grid((2, 2)), grid((2, 2), (2.0, 0.0)))
    domain = mesh_of(comm, "quadrilateral", points, cells)
    problem_on(domain, cell_tags=tags_of(domain, np.full(8, 7)))


@mistake("tag 7", "2 pieces", r"share 1 node \(at \(2, 2\)\)", "no facet")
def tag_on_two_pieces_that_share_a_vertex(comm):
    points, cells = merged(*together(grid((2, 2)), grid((2, 2), (2.0, 2.0))))
    domain = mesh_of(comm, "quadrilateral", points, cells)
    problem_on(domain, cell_tags=tags_of(domain, np.full(8, 7)))


@mistake("hang together", r"1 node \(at \(2, 2\)\)", "no facet", "body 0", "body 1", "own")
def bodies_that_share_a_vertex(comm):
    points, cells = merged(*together(grid((2, 2)), grid((2, 2), (2.0, 2.0))))
    problem_on(mesh_of(comm, "quadrilateral", points, cells))


@mistake("hang together", r"3 nodes \(the first at \(1, 0, 1\)\)", "cell tag 1.*cell tag 2")
def bodies_that_share_an_edge(comm):
    points, cells = merged(*together(grid((1, 2, 1)), grid((1, 2, 1), (1.0, 0.0, 1.0))))
    domain = mesh_of(comm, "hexahedron", points, cells)
    problem_on(domain, cell_tags=tags_of(domain, [1, 1, 2, 2]))


@mistake(
    "body 0", "2 pairs of nodes", "same place", r"\(2, 0\)", "crack", "(?i)merge", "ContactPair"
)
def nodes_at_the_same_place_in_a_body(comm):
    problem_on(mesh_of(comm, "quadrilateral", *slit(4)))


@mistake("1 of 4 cells", "without area", r"around \(2, 0\)", "body 0", "(?i)mesh")
def cell_without_area(comm):
    points = [(0, 0), (2, 0), (4, 0), (2, 2), (2, -2)]
    cells = [(0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 4)]
    problem_on(mesh_of(comm, "triangle", points, cells))


@mistake("1 of 3 cells", "without volume", r"\(0\.5, 0\.5, 1\)", "body 0")
def cell_without_volume(comm):
    points, cells = grid((1, 1, 3))
    points[points[:, 2] == 2.0, 2] = 1.0
    problem_on(mesh_of(comm, "hexahedron", points, cells))


@mistake("4 of 4 cells", "twisted", "sign", r"\(0\.5, 0\.5\)", "body 0", "order")
def vertices_in_the_order_of_gmsh(comm):
    points, cells = grid((2, 2))
    problem_on(mesh_of(comm, "quadrilateral", points, cells[:, [0, 1, 3, 2]]))


@mistake("cells that overlap", "same side", "body 0", "(?i)mesh")
def vertex_pushed_through_the_opposite_side(comm):
    points, cells = grid((3, 3))
    halves = np.concatenate([cells[:, [0, 1, 2]], cells[:, [1, 2, 3]]])
    points[5] = (2.3, 2.1)
    problem_on(mesh_of(comm, "triangle", points, halves))


@mistake("coordinates", "(?i)nan", "node")
def nan_in_a_coordinate(comm):
    points, cells = grid((2, 2))
    points[4, 1] = np.nan
    problem_on(mesh_of(comm, "quadrilateral", points, cells))


# -- numbers that are none -------------------------------------------------------------------------


@mistake("(?i)nan", "bilinear form|stiffness|material")
def nan_in_a_constant(comm):
    scene = beams(comm)
    scene.kept[0].value = np.nan
    scene.problem().solve()


@mistake("(?i)nan", "bilinear form|stiffness|material")
def nan_in_one_cell_of_a_coefficient(comm):
    scene = beams(comm)
    u, v = ufl.TrialFunction(scene.V), ufl.TestFunction(scene.V)
    young = fem.Function(scenes.scalar_space(scene.mesh, "DG", 0))
    # The one cell that holds the point (0.1, 0.1), on whatever rank it is.
    young.interpolate(lambda x: YOUNG * np.where((x[0] < 0.25) & (x[1] < 0.25), np.nan, 1.0))
    scene.a = scenes.elasticity(u, v, young)
    scene.problem().solve()


@mistake("(?i)nan", "linear form L|load|traction")
def nan_in_the_load(comm):
    scene = beams(comm)
    scene.kept[1].value = np.nan
    scene.problem().solve()


@mistake("(?i)nan", "prescribed|Dirichlet")
def nan_in_a_dirichlet_value(comm):
    scene = beams(comm)
    scene.bcs.append(scenes.fixed(scene.V, scene.facet_tags, ROLLER, 0, np.nan))
    scene.problem().solve()


# -- spaces and forms ------------------------------------------------------------------------------


def posed_on(scene: scenes.Scene, V) -> None:
    """Solve a Laplace-like problem on a space that the package does not support."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx
    load = fem.Constant(scene.mesh, 1.0)
    right = load * (v[0] if v.ufl_shape else v) * ufl.dx
    ContactProblem(a, right, bcs=[], contacts=scene.package_contacts()).solve()


@mistake("degree|order", r"\b2\b")
def space_of_degree_two(comm):
    scene = beams(comm)
    posed_on(scene, scenes.vector_space(scene.mesh, 2))


@mistake("scalar|vector|components")
def scalar_space(comm):
    scene = beams(comm)
    posed_on(scene, scenes.scalar_space(scene.mesh))


@mistake("symmetric")
def form_that_is_not_symmetric(comm):
    scene = beams(comm)
    u, v = ufl.TrialFunction(scene.V), ufl.TestFunction(scene.V)
    speed = fem.Constant(scene.mesh, 1e11)
    scene.a += speed * u[1].dx(0) * v[0] * ufl.dx
    scene.problem().solve()


@mistake("positive", error=Exception)
def form_that_is_negative(comm):
    scene = beams(comm)
    scene.kept[0].value = -YOUNG
    scene.problem().solve()


@mistake("linear|arguments|bilinear")
def forms_exchanged(comm):
    scene = beams(comm)
    scene.a, scene.L = scene.L, scene.a
    scene.problem().solve()


@mistake("space|mesh")
def forms_on_two_meshes(comm):
    scene, other = beams(comm), beams(comm)
    scene.L = other.L
    scene.problem().solve()


# -- supports --------------------------------------------------------------------------------------


@mistake("contradict|two (different )?values|different values")
def two_values_for_one_displacement(comm):
    scene = beams(comm)
    scene.bcs.append(scenes.fixed(scene.V, scene.facet_tags, CLAMPED, 1, 1e-3))
    scene.problem().solve()


@mistake("body", "2|upper", "translation|moves|motion", error=UnresistedMotion)
def pulled_away_from_the_contact(comm):
    scene = beams(comm)
    scene.kept[1].value = +scenes.TRACTION
    scene.problem().solve()


@mistake("body", "2|upper", "translation|moves|motion", error=UnresistedMotion)
def pushed_along_the_contact(comm):
    scene = beams(comm)
    v = ufl.TestFunction(scene.V)
    ds = ufl.Measure("ds", domain=scene.mesh, subdomain_data=scene.facet_tags)
    scene.L += scene.kept[1] * v[0] * ds(LOADED)
    scene.bcs = scene.bcs[:1]
    scene.problem().solve()


@mistake("body", "2|upper", "rotat", error=UnresistedMotion)
def tips_over_the_edge_of_its_support(comm):
    """The load stands on x > 2, where nothing is below the upper beam, and no roller holds it."""
    scene = beams(comm)
    x, v = ufl.SpatialCoordinate(scene.mesh), ufl.TestFunction(scene.V)
    load = scene.kept[1] * ufl.conditional(ufl.gt(x[0], 2.0), 1.0, 0.0)
    dx = ufl.Measure("dx", domain=scene.mesh, subdomain_data=scene.cell_tags)
    scene.L = load * v[1] * dx(2)
    scene.bcs = scene.bcs[:1]
    scene.problem().solve()


@mistake("body", "1|lower", error=UnresistedMotion)
def nothing_is_fixed(comm):
    scene = beams(comm)
    scene.problem(bcs=[]).solve()


# -- options ---------------------------------------------------------------------------------------


@mistake("subdomainsize", "subdomain_size")
def unknown_option(comm):
    beams(comm).problem(options={"subdomainsize": 100})


@mistake("rtol", "-1")
def option_out_of_range(comm):
    beams(comm).problem(options={"rtol": -1.0})


@mistake("preconditioner", "'jacobi'", "dirichlet")
def option_with_an_unknown_value(comm):
    beams(comm).problem(options={"preconditioner": "jacobi"})


# -- arguments -------------------------------------------------------------------------------------


@mistake("subdomains", "cells?")
def subdomains_of_a_wrong_length(comm):
    beams(comm).problem(subdomains=np.zeros(3, dtype=np.int32)).solve()


@mistake("cell_tags|bodies|cells")
def cells_without_a_tag(comm):
    scene = beams(comm)
    some = scene.cell_tags.find(1).astype(np.int32)
    tags = mesh.meshtags(scene.mesh, 2, some, np.ones(some.size, dtype=np.int32))
    scene.problem(cell_tags=tags).solve()


# -- the start from a coarse mesh ------------------------------------------------------------------


@mistake("float", "ContactProblem", "solved")
def coarse_is_no_problem(comm):
    beams(comm).problem().solve(coarse=2.0)


@mistake("not solved", r"solve\(\)")
def coarse_is_not_solved(comm):
    beams(comm).problem().solve(coarse=beams(comm).problem())


@mistake("3 dimensions", "2")
def coarse_of_another_dimension(comm):
    beams(comm).problem().solve(coarse=scenes.two_beams(comm, "hexahedron", 2).problem())


@mistake("obstacle", "pair", "same order")
def coarse_with_other_contacts(comm):
    coarse = scenes.pressed_block(comm, "quadrilateral").problem()
    beams(comm).problem().solve(coarse=coarse)


@mistake("active_set", "smalbe", "leave it out")
def coarse_with_another_method(comm):
    coarse = beams(comm).problem()
    beams(comm).problem(options={"method": "smalbe"}).solve(coarse=coarse)
