"""Torn systems with one mistake each, and what has to be said about it; no dolfinx."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from torn import column, cube

from fenics_tfeti.feti import ContactRows, Prescribed, Subdomain, TornSystem


@dataclass(frozen=True)
class Mistake:
    """`make` changes a part that one rank gives; the message contains all `words`."""

    name: str
    make: Callable[[TornSystem], TornSystem]
    words: tuple[str, ...]


MISTAKES: list[Mistake] = []


def column_on(comm: MPI.Comm) -> TornSystem:
    """Return the column, its cubes dealt to the ranks in turn; the last rank gives the rest."""
    whole = column()
    mine = whole.subdomains[comm.rank :: comm.size]
    prescribed, contacts = Prescribed(), ContactRows.none(3)
    if comm.rank == comm.size - 1:
        prescribed, contacts = whole.prescribed, whole.contacts
    return TornSystem(
        mine, prescribed, contacts, 3, whole.body_names, whole.contact_names, comm=comm
    )


def mistake(*words: str):
    def register(make: Callable[[TornSystem], TornSystem]) -> Callable[[TornSystem], TornSystem]:
        MISTAKES.append(Mistake(make.__name__, make, words))
        return make

    return register


def first(system: TornSystem, **fields: Any) -> TornSystem:
    """Change the rank's first subdomain."""
    changed = dataclasses.replace(system.subdomains[0], **fields)
    return dataclasses.replace(system, subdomains=[changed, *system.subdomains[1:]])


def prescribed(system: TornSystem, **fields: Any) -> TornSystem:
    return dataclasses.replace(system, prescribed=dataclasses.replace(system.prescribed, **fields))


def contacts(system: TornSystem, **fields: Any) -> TornSystem:
    return dataclasses.replace(system, contacts=dataclasses.replace(system.contacts, **fields))


def changed(values: np.ndarray, at: Any, value: Any) -> np.ndarray:
    copy = values.copy()
    copy[at] = value
    return copy


# -- subdomains ------------------------------------------------------------------------------------


@mistake("body of subdomain 0", "-1", "from 0 on")
def negative_body(system):
    return first(system, body=-1)


@mistake("body of subdomain 0", "1.0", "integer")
def body_that_is_no_integer(system):
    return first(system, body=1.0)


@mistake("body numbers", "1000000000", "without gaps")
def body_numbers_with_a_gap(system):
    return first(system, body=10**9)


@mistake("nodes of subdomain 0", "1 of 64", "-5", "position 3")
def negative_node_number(system):
    return first(system, nodes=changed(system.subdomains[0].nodes, 3, -5))


@mistake("nodes of subdomain 0", "1 node numbers", "more than once", "once")
def node_number_twice(system):
    nodes = system.subdomains[0].nodes
    return first(system, nodes=changed(nodes, 3, nodes[7]))


@mistake("nodes of subdomain 0", "1 of 64", "9223372036854775807")
def node_number_that_is_too_large(system):
    return first(system, nodes=changed(system.subdomains[0].nodes, 3, np.iinfo(np.int64).max))


@mistake("nodes of subdomain 0", "float64", "integers", "astype(numpy.int64)")
def node_numbers_that_are_no_integers(system):
    return first(system, nodes=system.subdomains[0].nodes.astype(float))


@mistake("coordinates of subdomain 0", "(64, 3)", "expected (63, 3)")
def node_numbers_of_a_wrong_length(system):
    return first(system, nodes=system.subdomains[0].nodes[1:])


@mistake("nodes of subdomain 0", "none", "out")
def subdomain_without_nodes(system):
    return first(
        system,
        nodes=[],
        load=[],
        coordinates=np.zeros((0, 3)),
        stiffness=sp.csr_matrix((0, 0)),
    )


@mistake("glued nodes", "different places", "global")
def local_node_numbers(system):
    return dataclasses.replace(
        system,
        subdomains=[
            dataclasses.replace(s, nodes=np.arange(s.nodes.size)) for s in system.subdomains
        ],
        prescribed=Prescribed(),
        contacts=ContactRows.none(3),
    )


@mistake("load of subdomain 0", "(191,)", "expected (192,)")
def load_of_a_wrong_length(system):
    return first(system, load=system.subdomains[0].load[1:])


@mistake("load of subdomain 0", "(64, 3)", "expected (192,)")
def load_by_nodes(system):
    return first(system, load=system.subdomains[0].load.reshape(-1, 3))


@mistake("load of subdomain 0", "complex128", "float64")
def load_that_is_complex(system):
    return first(system, load=system.subdomains[0].load + 0j)


@mistake("load of subdomain 0", "NoneType", "(192,)")
def load_that_is_none(system):
    return first(system, load=None)


@mistake("load of subdomain 0", "1 of 192", "NaN", "traction")
def load_with_nan(system):
    return first(system, load=changed(system.subdomains[0].load, 5, np.nan))


@mistake("coordinates of subdomain 0", "(64, 2)", "expected (64, 3)")
def coordinates_in_two_dimensions(system):
    return first(system, coordinates=system.subdomains[0].coordinates[:, :2])


@mistake("frame of subdomain 0", "(2, 2)", "expected (3, 3)")
def frame_in_two_dimensions(system):
    return first(system, frame=np.eye(2))


@mistake("frame of subdomain 0", "|T T' - I| = 3.000e+00", "orthogonal")
def frame_that_scales(system):
    return first(system, frame=2 * np.eye(3))


@mistake("coordinates of subdomain 0", "1 of 192", "infinite")
def coordinates_with_infinity(system):
    return first(system, coordinates=changed(system.subdomains[0].coordinates, (5, 1), np.inf))


@mistake("subdomains[0]", "dict", "Subdomain")
def subdomain_that_is_a_dictionary(system):
    return dataclasses.replace(system, subdomains=[vars(system.subdomains[0])])


@mistake("subdomains", "Subdomain", "list")
def one_subdomain_that_is_in_no_list(system):
    return dataclasses.replace(system, subdomains=system.subdomains[0])


# -- stiffness -------------------------------------------------------------------------------------


@mistake("stiffness of subdomain 0", "ndarray of shape (192, 192)", "csr_matrix(K)")
def dense_stiffness(system):
    return first(system, stiffness=system.subdomains[0].stiffness.toarray())


@mistake("stiffness of subdomain 0", "list", "csr_matrix(K)")
def stiffness_in_lists(system):
    return first(system, stiffness=system.subdomains[0].stiffness.toarray().tolist())


@mistake("stiffness of subdomain 0", "coo", "tocsr()")
def stiffness_by_coordinates(system):
    return first(system, stiffness=system.subdomains[0].stiffness.tocoo())


@mistake("stiffness of subdomain 0", "(189, 189)", "expected (192, 192)")
def stiffness_of_a_wrong_shape(system):
    return first(system, stiffness=system.subdomains[0].stiffness[3:, 3:])


@mistake("stiffness of subdomain 0", "float32", "astype(numpy.float64)")
def stiffness_in_single_precision(system):
    return first(system, stiffness=system.subdomains[0].stiffness.astype(np.float32))


@mistake("stiffness of subdomain 0", "1 of", "NaN", "material")
def stiffness_with_nan(system):
    K = system.subdomains[0].stiffness
    return first(system, stiffness=sp.csr_matrix((changed(K.data, 7, np.nan), K.indices, K.indptr)))


@mistake("stiffness of subdomain 0", "not symmetric", "symmetric form")
def stiffness_that_is_not_symmetric(system):
    K = system.subdomains[0].stiffness.copy()
    K[0, 1] += 1e-3
    return first(system, stiffness=K)


@mistake("stiffness of subdomain 0", "192 of 192 diagonal", "component 0", "positive moduli")
def negative_stiffness(system):
    return first(system, stiffness=-system.subdomains[0].stiffness)


@mistake("stiffness of subdomain 0", "3 of 192 diagonal", "vertex")
def node_without_cells(system):
    K = system.subdomains[0].stiffness.tolil()
    K[3:6, :] = 0.0
    K[:, 3:6] = 0.0
    return first(system, stiffness=K.tocsr())


@mistake("stiffness of subdomain 0", "not a valid csr matrix", "192")
def stiffness_with_indices_beyond_its_shape(system):
    K = system.subdomains[0].stiffness.copy()
    K.indices[-1] = 1000
    return first(system, stiffness=K)


@mistake("stiffness of subdomain 0", "2 parts", "subdomain of its own")
def subdomain_in_two_parts(system):
    one, other = system.subdomains[0], cube(3, (0, 0, 7), first=7 * 10**9)
    both = Subdomain(
        sp.block_diag([one.stiffness, other.stiffness], format="csr"),
        np.concatenate([one.load, other.load]),
        np.concatenate([one.coordinates, other.coordinates]),
        np.concatenate([one.nodes, other.nodes]),
        one.body,
    )
    return dataclasses.replace(system, subdomains=[both, *system.subdomains[1:]])


# -- bodies ----------------------------------------------------------------------------------------


def with_extra_cube(system: TornSystem, nodes_shared: int) -> TornSystem:
    """Add a cube to the rank's first body that shares some nodes of a vertical edge."""
    one = system.subdomains[0]
    extra = cube(3, (1, 1, 0), body=one.body, first=7 * 10**9)
    offset = np.array([0.0, 0.0, one.coordinates[:, 2].min()])
    coordinates = extra.coordinates + offset
    nodes = extra.nodes.copy()
    for k in range(nodes_shared):
        place = np.array([1.0, 1.0, k / 3]) + offset
        at = np.argmin(np.linalg.norm(coordinates - place, axis=1))
        nodes[at] = one.nodes[np.argmin(np.linalg.norm(one.coordinates - place, axis=1))]
    extra = dataclasses.replace(extra, nodes=nodes, coordinates=coordinates)
    return dataclasses.replace(system, subdomains=[*system.subdomains, extra])


@mistake("er: 1 of its", "share no node", "body number of its own")
def body_in_two_parts(system):
    return with_extra_cube(system, 0)


@mistake("hinged", "share too few nodes", "3 that are not on a line")
def body_hinged_at_a_node(system):
    return with_extra_cube(system, 1)


@mistake("hinged", "share too few nodes", "body number of its own")
def body_hinged_along_an_edge(system):
    return with_extra_cube(system, 4)


# -- prescribed displacements ----------------------------------------------------------------------


@mistake("prescribed.components", "not in [0, 3)", "-1")
def negative_component(system):
    return prescribed(system, components=changed(system.prescribed.components, 0, -1))


@mistake("prescribed.components", "not in [0, 3)", "is 3")
def component_that_is_too_large(system):
    return prescribed(system, components=changed(system.prescribed.components, 0, 3))


@mistake("prescribed.nodes", "-1", "position 0")
def prescribed_node_that_is_negative(system):
    return prescribed(system, nodes=changed(system.prescribed.nodes, 0, -1))


@mistake("node 777", "no subdomain")
def prescribed_node_of_no_subdomain(system):
    return prescribed(system, nodes=changed(system.prescribed.nodes, 0, 777))


@mistake("prescribed.values", "(1,)", "expected (80,)")
def prescribed_values_of_a_wrong_length(system):
    return prescribed(system, values=[0.0])


@mistake("prescribed.condition", "(1,)", "expected (80,)")
def prescribed_conditions_of_a_wrong_length(system):
    return prescribed(system, condition=[0])


@mistake("prescribed.condition", "not in [0, ", "-1")
def negative_condition(system):
    return prescribed(system, condition=changed(system.prescribed.condition, 0, -1))


@mistake("condition_names", "str", "list of strings")
def condition_names_that_are_one_string(system):
    return dataclasses.replace(system, condition_names="clamped")


@mistake("prescribed displacements", "NaN")
def prescribed_value_nan(system):
    return prescribed(system, values=changed(system.prescribed.values, 0, np.nan))


@mistake("prescribed", "NoneType", "Prescribed()")
def no_prescribed_displacements(system):
    return dataclasses.replace(system, prescribed=None)


# -- contact rows ----------------------------------------------------------------------------------


@mistake("contacts.nodes", "1 of 32", "-1", "position 0")
def row_with_a_negative_node(system):
    return contacts(system, nodes=changed(system.contacts.nodes, 0, -1))


@mistake("contacts.nodes", "2 rows name a node twice", "row 2 (joint)", "Add up")
def rows_with_a_node_twice(system):
    nodes = system.contacts.nodes.copy()
    nodes[[5, 9]] = nodes[[4, 8]]
    return contacts(system, nodes=nodes)


@mistake("node 777", "no subdomain")
def row_with_a_node_of_no_subdomain(system):
    return contacts(system, nodes=changed(system.contacts.nodes, 0, 777))


@mistake("contacts.nodes", "(32, 1)", "expected (k,)")
def nodes_in_a_column(system):
    return contacts(system, nodes=system.contacts.nodes[:, None])


@mistake("contacts.slaves", "1 rows", "row 0 (joint)", "with 9")
def more_slave_terms_than_terms(system):
    return contacts(system, slaves=changed(system.contacts.slaves, 0, 9))


@mistake("contacts.nodes", "float64", "integers")
def nodes_of_rows_that_are_no_integers(system):
    return contacts(system, nodes=system.contacts.nodes + 0.5)


@mistake("contacts.offsets", "from 0 to 32", "31 nodes")
def nodes_of_a_wrong_length(system):
    return contacts(system, nodes=system.contacts.nodes[1:])


@mistake("contacts.offsets", "from 1 to 32", "first has to be 0")
def offsets_that_begin_with_one(system):
    return contacts(system, offsets=changed(system.contacts.offsets, 0, 1))


@mistake("contacts.offsets", "(16,)", "expected (17,)")
def offsets_without_the_end(system):
    return contacts(system, offsets=system.contacts.offsets[:-1])


@mistake("contacts.offsets", "not ascending", "from 8 to 6", "row 4 (joint)", "positions")
def offsets_that_descend(system):
    return contacts(system, offsets=changed(system.contacts.offsets, 5, 6))


@mistake("contacts.offsets", "1 rows have no terms", "row 5 (joint)", "Leave them out")
def row_without_terms(system):
    return contacts(system, offsets=changed(system.contacts.offsets, 6, 10))


@mistake("contacts.coefficients", "(3,)", "expected (32, 3)")
def one_coefficient_for_all(system):
    return contacts(system, coefficients=[0.0, 0.0, -1.0])


@mistake(
    "contacts.coefficients",
    "sum of the slave's coefficients vanishes in 1 rows",
    "row 4 (joint)",
    "normal",
)
def slave_without_coefficient(system):
    values = changed(system.contacts.coefficients, 8, [0.0, 0.0, 1e-13])
    return contacts(system, coefficients=values)


@mistake("contacts.coefficients", "NaN")
def coefficient_with_nan(system):
    return contacts(system, coefficients=changed(system.contacts.coefficients, 4, np.nan))


@mistake("contacts.gap", "1 of 16", "NaN or -inf", "+inf")
def gap_of_minus_infinity(system):
    return contacts(system, gap=changed(system.contacts.gap, 4, -np.inf))


@mistake("contacts.gap", "1 of 16", "NaN")
def gap_that_is_nan(system):
    return contacts(system, gap=changed(system.contacts.gap, 4, np.nan))


@mistake("contacts.contact", "-1")
def contact_number_that_is_negative(system):
    return contacts(system, contact=changed(system.contacts.contact, 4, -1))


@mistake("contacts.contact", "1000000000", "16 contact rows", "0, 1, ...")
def contact_number_that_is_too_large(system):
    return contacts(system, contact=changed(system.contacts.contact, 4, 10**9))


@mistake("contacts", "NoneType", "ContactRows.none")
def no_contact_rows(system):
    return dataclasses.replace(system, contacts=None)


# -- tied rows -------------------------------------------------------------------------------------


def tied(system: TornSystem, **fields: Any) -> TornSystem:
    """Tie the nodes of the contact along x, with some fields of the rows changed."""
    rows = dataclasses.replace(system.contacts, coefficients=system.contacts.coefficients[:, ::-1])
    return dataclasses.replace(system, tied=dataclasses.replace(rows, **fields))


@mistake("tied.gap", "1 of 16", "NaN or infinite", "nothing to tie to")
def tied_row_with_an_infinite_gap(system):
    return tied(system, gap=changed(system.contacts.gap, 4, np.inf))


@mistake("tied.nodes", "1 rows name a node twice", "row 2 (joint)")
def tied_row_with_a_node_twice(system):
    nodes = system.contacts.nodes
    return tied(system, nodes=changed(nodes, 5, nodes[4]))


@mistake("tied.coefficients", "sum of the slave's coefficients vanishes in 1 rows", "row 0 (joint)")
def tied_row_without_a_direction(system):
    values = system.contacts.coefficients[:, ::-1]
    return tied(system, coefficients=changed(values, 0, 0.0))


@mistake("tied.offsets", "(16,)", "expected (17,)")
def tied_offsets_without_the_end(system):
    return tied(system, offsets=system.contacts.offsets[:-1])


@mistake("tied.contact", "1000000000", "0, 1, ...")
def tied_pair_with_a_number_that_is_too_large(system):
    return tied(system, contact=changed(system.contacts.contact, 4, 10**9))


@mistake("node 777", "no subdomain")
def tied_node_of_no_subdomain(system):
    return tied(system, nodes=changed(system.contacts.nodes, 0, 777))


@mistake("tied", "NoneType", "ContactRows")
def tied_rows_that_are_none(system):
    return dataclasses.replace(system, tied=None)


# -- the system ------------------------------------------------------------------------------------


@mistake("gdim", "4", "2 or 3")
def four_dimensions(system):
    return dataclasses.replace(system, gdim=4)


@mistake("gdim", "3.0", "2 or 3")
def dimension_that_is_no_integer(system):
    return dataclasses.replace(system, gdim=3.0)


@mistake("body_names", "str", "list of strings")
def one_name_for_all_bodies(system):
    return dataclasses.replace(system, body_names="lower")


@mistake("contact_names", "int", "strings")
def contact_name_that_is_a_number(system):
    return dataclasses.replace(system, contact_names=[1])
