"""Nodes in several contact conditions: equal ones are one, what contradicts is an error."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from torn import column, cube

from fenics_tfeti import InputError
from fenics_tfeti.feti import (
    ContactRows,
    Friction,
    Options,
    Prescribed,
    Subdomain,
    TornSolver,
    TornSystem,
)
from fenics_tfeti.feti.constraints.rows import build_constraints

pytestmark = pytest.mark.once

SECOND = 10**9
NODE, OTHER = 2 * 1000 * 1000 + 2 * 1000 + 2, SECOND + 10  # of the first and of the second cube
X, Y, Z = np.eye(3)


def conditions(*rows) -> ContactRows:
    """Make rows (slave, master, normal, gap)."""
    slave, master, normal, gap = zip(*rows, strict=True)
    return ContactRows.node_to_node(slave, master, normal, gap, np.arange(len(rows)))


def two_cubes(contacts, prescribed=None) -> TornSystem:
    cubes = [cube(2), cube(2, (1, 0, 0)), cube(2, (0, 0, 5), body=1, first=SECOND)]
    return TornSystem(cubes, prescribed or Prescribed(), contacts, 3)


def fixed(node: int, *components: int) -> Prescribed:
    k = len(components)
    return Prescribed(np.full(k, node), np.array(components), np.zeros(k))


@pytest.mark.parametrize(
    ("first", "second", "prescribed", "stays"),
    [
        ((NODE, -1, Z, 0.2), (NODE, -1, Z, 0.1), None, 1),
        ((NODE, OTHER, X, 0.1), (NODE, OTHER, X, 0.3), None, 0),
        ((NODE, OTHER, X, 0.3), (OTHER, NODE, -X, 0.1), None, 1),
        # what is prescribed takes the difference away
        ((NODE, -1, X + Z, 0.1), (NODE, -1, X + 2 * Z, 0.1), fixed(NODE, 0), 1),
        ((NODE, -1, Z, 0.2), (NODE, OTHER, Z, 0.1), fixed(OTHER, 0, 1, 2), 1),
    ],
    ids=["looser", "pair", "exchanged", "parallel to what is free", "held master"],
)
def test_the_strictest_of_parallel_rows_stays(first, second, prescribed, stays):
    constraints, c = build_constraints(two_cubes(conditions(first, second), prescribed))
    assert constraints.redundant == 1
    assert (constraints.contacts.own_rows >= 0).tolist() == [stays == 0, stays == 1]


def with_areas(rows: ContactRows, *areas: float) -> ContactRows:
    return dataclasses.replace(rows, area=np.array(areas))


@pytest.mark.parametrize(
    ("areas", "shares"),
    [
        ((1.0, 3.0), (0.25, 0.75)),
        ((np.nan, np.nan), (0.5, 0.5)),
        # on the axis of an axisymmetric body
        ((0.0, 0.0), (0.5, 0.5)),
    ],
)
def test_equal_rows_are_one_and_share_its_force_by_area(areas, shares):
    rows = conditions((NODE, OTHER, Z, 0.1), (OTHER, NODE, -Z, 0.1), (NODE, -1, X, 0.0))
    constraints, _ = build_constraints(two_cubes(with_areas(rows, *areas, 1.0)))
    assert (constraints.redundant, constraints.dependent) == (1, 0)
    assert constraints.contacts.own_rows[0] == constraints.contacts.own_rows[1]
    force = constraints.contacts.forces(np.full(constraints.size, 2.0))
    np.testing.assert_allclose(force[:2] / force[:2].sum(), shares)


@pytest.mark.parametrize("kind", ["contacts", "tied"])
def test_forces_of_conditions_with_one_row_add_up_to_its_force(kind):
    """A support takes a part of each condition; those that are left differ in length."""
    rows = conditions((NODE, -1, X + Z, 0.0), (NODE, -1, X + 2 * Z, 0.0))
    system = two_cubes(ContactRows.none(3), fixed(NODE, 0))
    constraints, _ = build_constraints(dataclasses.replace(system, **{kind: rows}))
    given = getattr(constraints, kind)
    assert given.own_rows[0] == given.own_rows[1]
    multipliers = np.zeros(constraints.size)
    multipliers[given.own_rows[0]] = 1.0
    of_row = (constraints.matrix.T @ multipliers).sum()
    along_z = [1.0 / np.sqrt(2.0), 2.0 / np.sqrt(5.0)]
    assert given.forces(multipliers) @ along_z == pytest.approx(of_row, rel=1e-12)


@pytest.mark.parametrize(
    ("second", "is_one"), [((X, Y), True), ((Y, X), False)], ids=["same", "turned"]
)
def test_friction_of_equal_rows_is_one_site(second, is_one):
    """Its bound is the sum of theirs, each for its share of the normal force."""
    rows = with_areas(conditions((NODE, OTHER, Z, 0.1), (NODE, OTHER, Z, 0.1)), 1.0, 3.0)
    friction = Friction([0, 1], [(X, Y), second], [2.0, 0.0], coefficient=[0.1, 0.2])
    system = dataclasses.replace(two_cubes(rows), friction=friction)
    sites = build_constraints(system)[0].friction
    bound = sites.scale * sites.bound.at(np.ones(sites.size) / sites.scale)
    parts = [2.0 + 0.1 * 0.25, 0.2 * 0.75]
    np.testing.assert_allclose(np.sort(bound)[::-1], [sum(parts)] if is_one else parts)


@pytest.mark.parametrize(("rows", "dependent"), [
    ([(NODE, -1, n, 0.1) for n in (X, Y, Z)], 0),
    ([(NODE, -1, n, 0.1) for n in (X, Y, X + Y)], 1),
    ([(NODE, -1, n, 0.1) for n in (X, -X)], 1),
    ([(NODE, -1, n, 0.1) for n in (X, Y, Z, X + Z, Y + Z)], 2),
    ([(NODE, -1, Z, 0.1), (NODE - 1, -1, Z, 0.1), (OTHER, -1, Z, 0.1)], 0),
    # a node of a body between two others is slave and master at once
    ([(NODE, OTHER, Z, 0.1), (OTHER, NODE - 1, Z, 0.1), (NODE - 1, -1, Z, 0.1)], 0),
    # no room at all, and less by rounding
    ([(NODE, -1, Z, 0.1), (NODE, -1, -Z, -0.1)], 1),
    ([(NODE, -1, Z, 0.3), (NODE, -1, -Z, np.nextafter(-0.3, -1.0))], 1),
])  # fmt: skip
def test_other_dependent_rows_stay_and_are_counted(rows, dependent):
    constraints, _ = build_constraints(two_cubes(conditions(*rows)))
    assert (constraints.redundant, constraints.dependent) == (0, dependent)


def tied(contacts, ties) -> TornSystem:
    return dataclasses.replace(two_cubes(contacts), tied=ties)


@pytest.mark.parametrize(
    ("normal", "gap", "message"),
    [
        (Z, 0.1, None),
        (-Z, -0.1, None),
        (Z, 0.3, None),
        (-Z, 0.3, None),
        (Z, 0.1 - 1e-9, "1 conditions contradict tied ones"),
        (-Z, -0.1 - 1e-9, "1 conditions contradict tied ones"),
    ],
    ids=["equal", "opposite", "far", "opposite and far", "closer", "opposite and closer"],
)
def test_tied_row_decides_contact_rows_along_it(normal, gap, message):
    contact = conditions((NODE, OTHER, normal, gap), (NODE, OTHER, X, 0.0))
    tie = conditions((OTHER, NODE, -Z, 0.1))
    if message:
        with pytest.raises(InputError, match=rf"{message}.*{NODE}"):
            build_constraints(tied(contact, tie))
        return
    constraints, _ = build_constraints(tied(contact, tie))
    assert constraints.redundant == 1
    assert (constraints.contacts.own_rows >= 0).tolist() == [False, True]
    assert constraints.tied.own_rows[0] >= 0


def test_surface_tied_twice():
    """The force of the second row, in the other direction, has the other sign."""
    same, closer = (conditions((NODE, OTHER, Z, 0.1), (NODE, OTHER, -Z, g)) for g in (-0.1, 0.1))
    constraints, _ = build_constraints(tied(ContactRows.none(3), with_areas(same, 1.0, 3.0)))
    assert constraints.redundant == 1
    np.testing.assert_allclose(constraints.tied.share, [0.25, -0.75])
    with pytest.raises(InputError, match="2 conditions contradict tied ones"):
        build_constraints(tied(ContactRows.none(3), closer))


@pytest.mark.parametrize(
    ("ties", "tangential"),
    [
        # along all axes: the contact, inclined to them, is decided, and nothing can slip
        ([(X, 0.0), (Y, 0.0), (Z, 0.0)], 0),
        # the gap stays open
        ([(Z, 0.0), (X, -0.2)], 0),
        # the normal is free
        ([(Y, 0.0)], 1),
    ],
    ids=["all", "open", "one"],
)
def test_what_ties_decide_takes_its_friction_with_it(ties, tangential):
    normal = np.array([0.6, 0.0, 0.8])
    contact = conditions((NODE, OTHER, normal, 0.0))
    friction = Friction([0], [[[0.8, 0.0, -0.6], Y]], [0.0], coefficient=[0.3])
    system = tied(contact, conditions(*((NODE, OTHER, axis, gap) for axis, gap in ties)))
    constraints, _ = build_constraints(dataclasses.replace(system, friction=friction))
    assert (constraints.contacts.own_rows >= 0).tolist() == [len(ties) == 1]
    assert np.count_nonzero(constraints.friction.present) == tangential


@pytest.mark.parametrize("gap", [0.0, 0.1])
def test_coefficient_where_tied_rows_carry_the_normal_force(gap):
    """With a gap that stays open there is no friction."""
    friction = Friction([0], [[X, Y]], [0.0], coefficient=[0.3])
    system = tied(conditions((NODE, OTHER, Z, gap)), conditions((NODE, OTHER, Z, 0.0)))
    system = dataclasses.replace(system, friction=friction)
    if gap:
        assert not build_constraints(system)[0].friction.size
        return
    with pytest.raises(InputError, match=rf"slave node {NODE}, the normal force is not known"):
        build_constraints(system)


BODY = 3 * 10**9


def bodies_on_a_line(*rows: tuple[int, float, float]) -> TornSystem:
    """Return rows (body, sign of the normal, gap) between NODE and rigid bodies, -1 for none.

    A body has one node and moves along z.
    """
    along = Z[:, None]
    bodies = [
        Subdomain.rigid(np.zeros(3), [[0.0, 0.0, 1.0]], [BODY + k], 2 + k, along) for k in (0, 1)
    ]
    contacts = conditions(
        *((NODE, -1 if k < 0 else BODY + k, sign * Z, gap) for k, sign, gap in rows)
    )
    system = two_cubes(contacts)
    return dataclasses.replace(system, subdomains=[*system.subdomains, *bodies])


@pytest.mark.parametrize(
    ("rows", "different"),
    [
        ([(0, 1, 0.1), (-1, 1, 0.05)], 2),
        ([(0, 1, 0.1), (1, 1, 0.1)], 2),
        ([(0, 1, 0.1), (0, 1, 0.1)], 1),
        # opposite rows of bodies that can give way
        ([(0, 1, 0.1), (-1, -1, -0.2)], 2),
        ([(0, 1, 0.1), (1, -1, -0.2)], 2),
    ],
    ids=["body and stop", "two bodies", "one body", "clamped", "clamped by two"],
)
def test_rows_of_different_rigid_bodies_are_different(rows, different):
    system = bodies_on_a_line(*rows)
    constraints, _ = build_constraints(system)
    assert np.unique(constraints.contacts.own_rows).size == different
    assert constraints.dependent == 0
    TornSolver(system)


def test_no_room_between_two_sides_of_one_body():
    with pytest.raises(InputError, match="exclude each other"):
        build_constraints(bodies_on_a_line((0, 1, 0.1), (0, -1, -0.2)))


@pytest.mark.parametrize("bodies", [(0, 0), (0, 1)], ids=["one", "two"])
def test_ties_to_different_rigid_bodies(bodies):
    system = bodies_on_a_line(*((k, 1, 0.0) for k in bodies))
    system = dataclasses.replace(system, tied=system.contacts, contacts=ContactRows.none(3))
    assert np.unique(build_constraints(system)[0].tied.own_rows).size == len(set(bodies))


@pytest.mark.parametrize("room", [-0.1, -1e-9, -1e-10])
def test_other_gaps_hide_no_conditions_that_exclude_each_other(room):
    rows = conditions((NODE, -1, Z, 0.0), (NODE, -1, -Z, room), (NODE, -1, X, 1e10))
    message = f"1 pairs of contact conditions exclude each other.*{NODE}"
    with pytest.raises(InputError, match=message):
        build_constraints(two_cubes(rows))


def test_infinite_gap_implies_and_excludes_nothing():
    rows = conditions((NODE, -1, Z, np.inf), (NODE, -1, Z, 0.1), (NODE, -1, -Z, np.inf))
    constraints, c = build_constraints(two_cubes(rows))
    assert (constraints.redundant, constraints.dependent, constraints.infinite_gaps) == (0, 0, 2)
    assert constraints.coupling.numbers.size == 0


def coupled_systems() -> dict[str, TornSystem]:
    """Return systems with nodes in several contacts; NODE has copies in two subdomains."""
    chain = [(NODE, OTHER, Z, 0.1), (OTHER, NODE - 1, X + Z, 0.1), (NODE - 1, -1, Y + Z, 0.1)]
    walls = [(NODE, -1, normal, 0.1) for normal in (X, Y, X + Y, X + Z)]
    apart = [(NODE, -1, Z, 0.1), (NODE - 1, -1, Z, 0.1), (OTHER, -1, Z, 0.1)]
    looser = [(NODE, -1, Z, 0.3), (OTHER, -1, Y, 0.1), (OTHER, NODE - 1, Y + Z, 0.2)]
    return {
        "chain": two_cubes(conditions(*chain)),
        "walls": two_cubes(conditions(*walls, (NODE, -1, X, 0.2))),
        "held": two_cubes(conditions(*walls, *chain), fixed(NODE, 0)),
        "orthogonal": two_cubes(conditions(*apart, (NODE, -1, X, 0.1))),
        "dropped": two_cubes(conditions(*apart, *looser)),
        "corner": in_a_corner([(-X - Y, 0.0), (-Y - Z, 0.1)]),
    }


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(("name", "coupled"), [
    ("chain", 3), ("walls", 4), ("held", 4), ("orthogonal", 0), ("dropped", 4), ("corner", 5),
])  # fmt: skip
def test_gram_matrix_is_the_identity_but_for_coupled_rows(name, coupled, weighted):
    system = coupled_systems()[name]
    copies = sum(subdomain.nodes.size for subdomain in system.subdomains)
    weights = 10.0 ** np.random.default_rng(0).uniform(-4.0, 0.0, copies) if weighted else None
    constraints, _ = build_constraints(system, weights)
    B = constraints.matrix.toarray() / np.sqrt(constraints.weights)
    coupling = constraints.coupling
    expected = np.eye(len(B))
    rows = coupling.rows[np.argsort(coupling.positions)]
    expected[np.ix_(rows, rows)] = coupling.gram.toarray()
    np.testing.assert_allclose(B @ B.T, expected, rtol=0.0, atol=1e-14)
    assert rows.size == coupled
    assert np.all(np.isin(rows, constraints.inequality))
    np.testing.assert_array_equal(constraints.layout.numbers[rows], coupling.numbers)


def in_a_corner(extra_rows=()) -> TornSystem:
    """A cube pushed into the corner of three rigid walls, its edges and a node on several."""
    block = cube(2, load=(-1.0, -2.0, -3.0))
    rows = [
        (node, -1, -axis, 0.0)
        for component, axis in enumerate(np.eye(3))
        for node in block.nodes[block.coordinates[:, component] == 0]
    ]
    rows += [(block.nodes[0], -1, normal, gap) for normal, gap in extra_rows]
    contacts = conditions(*rows)
    contact = np.repeat([0, 1, 2, 3], [9, 9, 9, len(extra_rows)])
    contacts = dataclasses.replace(contacts, contact=contact)
    return dataclasses.replace(
        column(), subdomains=[block], contacts=contacts, prescribed=Prescribed()
    )


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
@pytest.mark.parametrize(
    "extra", [[], [(-X, 0.0)], [(-X - Y, 0.0)], [(X, 0.0), (-Y - Z, 0.0)]], ids=str
)
def test_walls_of_a_corner_bear_the_load(method, extra):
    system = in_a_corner(extra)
    solution = TornSolver(system, Options(rtol=1e-8, method=method)).solve()
    borne = solution.normal_force @ system.contacts.normal
    np.testing.assert_allclose(borne, [-1.0, -2.0, -3.0], rtol=1e-7)
