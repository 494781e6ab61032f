from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from sparse_rows import clamped, random_rows, two_blocks
from torn import column, cube, with_fields, with_prescribed

from fenics_tfeti import InputError
from fenics_tfeti.feti import ContactRows, Prescribed, TornSystem
from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.constraints.rows import build_constraints
from fenics_tfeti.feti.constraints.scaling import node_weights


def eight_cubes(**parts) -> TornSystem:
    """Eight glued cubes: nodes with two, four and eight copies."""
    cubes = [cube(2, (i, j, k)) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    parts = {"prescribed": Prescribed(), "contacts": ContactRows.none(3), **parts}
    return TornSystem(cubes, gdim=3, **parts)


def one_row(slave: int, normal, gap: float = 0.0) -> ContactRows:
    return ContactRows.node_to_node([slave], [-1], [normal], [gap], [0])


CENTRE = 2 * 1000 * 1000 + 2 * 1000 + 2  # the node that all eight cubes share


def fixed(component: int, *values: float, node: int = CENTRE) -> Prescribed:
    return Prescribed(np.full(len(values), node), np.full(len(values), component), values)


GLUED = {"glued": eight_cubes(), "glued column": column(contact=False)}
ALL = GLUED | {
    "column": column(),
    "fixed": eight_cubes(prescribed=fixed(1, 0.5)),
    "contact": eight_cubes(contacts=one_row(CENTRE, (0.6, 0.0, 0.8))),
    "fixed and contact": eight_cubes(
        prescribed=fixed(0, 0.5), contacts=one_row(CENTRE, (0.6, 0.0, 0.8))
    ),
}


def random_weights(system: TornSystem, seed: int) -> np.ndarray:
    """Return weights of the copies between 1e-4 and 1."""
    copies = sum(subdomain.nodes.size for subdomain in system.subdomains)
    return 10.0 ** np.random.default_rng(seed).uniform(-4.0, 0.0, copies)


@pytest.mark.parametrize("name", ALL)
def test_rows_are_orthonormal_in_the_inverse_weights(name):
    system = ALL[name]
    multiplicity = node_weights(system, "multiplicity").values
    for weights in (None, multiplicity, *(random_weights(system, seed) for seed in range(3))):
        constraints, _ = build_constraints(system, weights)
        B = constraints.matrix.toarray()
        assert weights is not None or np.all(constraints.weights == 1.0)
        gram = B / constraints.weights @ B.T
        np.testing.assert_allclose(gram, np.eye(len(B)), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("name", ALL)
def test_weights_keep_the_constraints(name):
    """They combine gluing rows with gluing rows and scale the others by positive numbers."""
    plain, c = build_constraints(ALL[name])
    weighted, weighted_c = build_constraints(ALL[name], random_weights(ALL[name], 0))
    factor = weighted.contacts.scale / plain.contacts.scale
    assert np.all(factor > 0.0)
    u = np.linalg.lstsq(plain.matrix.toarray(), c, rcond=None)[0]
    np.testing.assert_allclose(weighted.matrix @ u, weighted_c, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", GLUED)
def test_glued_displacements_violate_no_gluing_row(name):
    """One displacement for each node, zero where it is fixed, fulfils all rows with c = 0."""
    system = GLUED[name]
    constraints, _ = build_constraints(system)
    rng = np.random.default_rng(0)
    value = {node: rng.standard_normal(3) for s in system.subdomains for node in s.nodes}
    fixed = system.prescribed
    for node, component in zip(fixed.nodes, fixed.components, strict=True):
        value[node][component] = 0.0
    u = np.concatenate([[value[n] for n in s.nodes] for s in system.subdomains]).ravel()
    np.testing.assert_allclose(constraints.matrix @ u, 0.0, atol=1e-13)


def test_number_of_gluing_rows():
    """There are k - 1 rows for each component of a node with k copies, 3 x 144 in all."""
    constraints, _ = build_constraints(eight_cubes())
    torn, nodes = 8 * 3**3, 5**3
    assert constraints.matrix.shape[0] == 3 * (torn - nodes)


def test_contact_row_is_that_of_the_chapter_on_glued_displacements():
    system = column()
    constraints, _ = build_constraints(system)
    u = np.concatenate(
        [np.tile([0.0, 0.0, float(s.body)], s.nodes.size) for s in system.subdomains]
    )
    jump = (constraints.matrix @ u)[constraints.inequality] / constraints.rows.of(
        Kind.CONTACT
    ).scale
    np.testing.assert_allclose(jump, -1.0, rtol=1e-14)  # (u_slave - u_master)'n, n downwards


def test_prescribed_part_of_a_normal_goes_to_the_gap():
    """A row of which it is all is dropped."""
    rows = one_row(CENTRE, (0.6, 0.0, 0.8), gap=1.0)
    constraints, c = build_constraints(eight_cubes(prescribed=fixed(0, 0.5), contacts=rows))
    gap = c[constraints.inequality] / constraints.rows.of(Kind.CONTACT).scale
    np.testing.assert_allclose(gap, 1.0 - 0.6 * 0.5)
    decided = eight_cubes(prescribed=fixed(2, 0.1), contacts=one_row(CENTRE, (0, 0, 1), gap=0.2))
    assert build_constraints(decided)[0].contacts.own_rows.tolist() == [-1]


@pytest.mark.parametrize(("parts", "message"), [
    ({"prescribed": fixed(2, 0.3), "contacts": one_row(CENTRE, (0, 0, 1), 0.2)}, "violate"),
    ({"prescribed": fixed(2, 0.3, node=7)}, "node 7"),
    ({"contacts": one_row(7, (0, 0, 1))}, "node 7"),
    ({"prescribed": fixed(2, 0.3, 0.1)}, "contradictory"),
])  # fmt: skip
def test_wrong_input(parts, message):
    with pytest.raises(InputError, match=message):
        build_constraints(eight_cubes(**parts))


def both_sides(values, gap: float, size: float = 1.0) -> TornSystem:
    """Return the column with one pair of nodes prescribed in the direction of the normal."""
    system = column()
    prescribed = Prescribed(system.contacts.nodes[:2], np.array([2, 2]), np.array(values))
    cubes = [dataclasses.replace(s, coordinates=size * s.coordinates) for s in system.subdomains]
    system = dataclasses.replace(system, subdomains=cubes, prescribed=prescribed)
    return with_fields(system, "contacts", gap=np.full(system.contacts.gap.size, gap))


@pytest.mark.parametrize(
    "system",
    [
        both_sides([0.3, np.nextafter(0.3, 1.0)], 0.0),
        both_sides([np.nextafter(0.3, 0.0), 0.3], 0.0),
        both_sides([-0.2, 0.1], 0.3 - 2e-16),
        # gaps are differences of positions
        both_sides([0.0, 0.0], -1e-13),
        both_sides([0.0, 0.0], -1e-10, size=1e3),
    ],
    ids=["last bit", "other last bit", "gap closed", "rounded gap", "rounded gap, kilometres"],
)
def test_rounding_of_prescribed_displacements_violates_nothing(system):
    constraints, _ = build_constraints(system)
    assert np.count_nonzero(constraints.contacts.own_rows < 0) == 1


@pytest.mark.parametrize("system", [
    both_sides([-0.3, -0.3 + 1e-9], 0.0),
    both_sides([-0.2, 0.1], 0.3 - 1e-9),
    both_sides([0.0, 1e-11], 0.0),
    both_sides([0.0, 1e-14], 0.0, size=1e-3),
], ids=["penetration", "gap closed", "small", "small, millimetres"])  # fmt: skip
def test_prescribed_displacements_that_violate_a_condition(system):
    """Whatever moves elsewhere, and however large other gaps are."""
    system = with_prescribed(system, system.subdomains[0].nodes[:1], [0], 0.02)
    gap = np.append(system.contacts.gap[0], np.full(system.contacts.size - 1, 1e10))
    with pytest.raises(InputError, match="violate 1 contact"):
        build_constraints(with_fields(system, "contacts", gap=gap))


def prescribed_twice(one: float, other: float, far: float = 0.02) -> TornSystem:
    """Return the cubes with two values for one displacement and a third elsewhere."""
    nodes, components = np.array([CENTRE, CENTRE, 0]), np.array([2, 2, 0])
    return eight_cubes(prescribed=Prescribed(nodes, components, np.array([one, other, far])))


@pytest.mark.parametrize(
    ("one", "other"),
    [(0.3, np.nextafter(0.3, 1.0)), (1e-9, 1e-9 + 1e-16), (0.0, 1e-17), (0.0, -0.0)],
)
def test_equal_values_may_differ_by_rounding(one, other):
    constraints, c = build_constraints(prescribed_twice(one, other))
    np.testing.assert_allclose(np.abs(c).max(), max(one, 0.02))


@pytest.mark.parametrize(("one", "other"), [(0.0, 1e-12), (1e-9, 1.001e-9), (0.3, 0.3 + 1e-9)])
def test_contradiction_does_not_depend_on_displacements_elsewhere(one, other):
    with pytest.raises(InputError, match=f"contradictory.*node {CENTRE}"):
        build_constraints(prescribed_twice(one, other))


def test_infinite_gaps_are_no_rows():
    gap = np.where(np.arange(16) % 3 == 0, np.inf, 0.1)
    constraints, c = build_constraints(with_fields(column(), "contacts", gap=gap))
    assert constraints.infinite_gaps == 6
    np.testing.assert_array_equal(constraints.contacts.own_rows < 0, np.isinf(gap))
    np.testing.assert_allclose(
        c[constraints.inequality] / constraints.rows.of(Kind.CONTACT).scale, 0.1
    )


def test_infinite_gap_of_a_row_that_prescribed_displacements_decide():
    system = both_sides([0.0, 0.5], np.inf)
    constraints, c = build_constraints(system)
    assert constraints.infinite_gaps == 16
    assert constraints.inequality.size == 0
    assert np.all(np.isfinite(c))


def test_order_of_subdomains_does_not_change_what_is_constrained():
    system = column()
    turned = dataclasses.replace(system, subdomains=system.subdomains[::-1])
    ranks = [
        np.linalg.matrix_rank(build_constraints(s)[0].matrix.toarray()) for s in (system, turned)
    ]
    assert ranks[0] == ranks[1]


def random_system(seed: int) -> TornSystem:
    """Return two blocks with random rows, some of their nodes in several subdomains or held."""
    rng, blocks = np.random.default_rng(seed), two_blocks(2, 2)
    contacts, tied = random_rows(blocks, rng, 25), random_rows(blocks, rng, 10)
    return TornSystem(blocks, clamped(blocks, (0, 1.0)), contacts, 3, tied=tied)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_gram_matrix_of_random_rows(seed, weighted):
    """B D^{-1} B' is the identity but for W of contact and tied rows, of any length."""
    system = random_system(seed)
    weights = random_weights(system, seed) if weighted else None
    constraints, _ = build_constraints(system, weights)
    coupling, tied = constraints.coupling, constraints.rows.where(Kind.TIED)
    B = constraints.matrix.toarray() / np.sqrt(constraints.weights)
    expected = np.eye(len(B))
    expected[np.ix_(coupling.rows, coupling.rows)] = coupling.gram.toarray()
    np.testing.assert_allclose(B @ B.T, expected, rtol=0.0, atol=1e-14)
    assert np.isin(coupling.rows, np.append(constraints.inequality, tied)).all()
    np.testing.assert_array_equal(np.isin(coupling.rows, tied), coupling.tied)
    assert constraints.equality[tied].all()


def test_jumps_of_random_rows_are_distances():
    """On glued displacements a jump divided by the scale is that of the unit row."""
    system = random_system(0)
    constraints, c = build_constraints(system)
    rng = np.random.default_rng(1)
    value = {node: rng.normal(size=3) for s in system.subdomains for node in s.nodes}
    value |= {node: np.zeros(3) for node in system.prescribed.nodes}
    u = np.concatenate([[value[n] for n in s.nodes] for s in system.subdomains]).ravel()
    jump = constraints.matrix @ u
    for rows, given in ((system.contacts, constraints.contacts), (system.tied, constraints.tied)):
        terms = np.sum(rows.coefficients * [value[n] for n in rows.nodes], axis=1)
        distance = np.add.reduceat(terms, rows.offsets[:-1]) / rows.length
        own, scale = given.own_rows, given.scale
        np.testing.assert_allclose(jump[own] / scale, distance, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(c[own] / scale, rows.gap / rows.length, rtol=1e-12)


def test_coefficients_of_a_node_on_both_surfaces_add_up():
    """The tip of a crack: its part of the slave is in the length of the row, so in its force."""
    slave, tip, master = CENTRE, CENTRE + 1, CENTRE - 1
    both = ([slave, tip, master, tip], [1.0, 0.5, -1.2, -0.3], [2])
    once = ([slave, tip, master], [1.0, 0.2, -1.2], [2])
    rows = [
        ContactRows([0, len(nodes)], nodes, np.outer(weights, [0.6, 0.0, 0.8]), [0.15], [0], slaves)
        for nodes, weights, slaves in (both, once)
    ]
    assert [float(r.length[0]) for r in rows] == pytest.approx([1.5, 1.2])
    (first, c), (second, d) = (build_constraints(eight_cubes(contacts=r)) for r in rows)
    np.testing.assert_allclose((first.matrix - second.matrix).toarray(), 0.0, atol=1e-15)
    np.testing.assert_allclose(c, d, rtol=1e-14)
