"""Torn systems with one mistake each, and what has to be said about it; no dolfinx."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from torn import column, cube

from fenics_tfeti.feti import ContactRows, Prescribed, Subdomain, TornSystem

Change = Callable[[TornSystem], TornSystem]
# what changes a part that one rank gives, and words that are in the message
Mistake = tuple[Change, *tuple[str, ...]]


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


# -- changes: a function of a field's value, or a new value ----------------------------------------


def changed(part: Any, fields: dict[str, Any]) -> Any:
    values = {k: v(getattr(part, k)) if callable(v) else v for k, v in fields.items()}
    return replace(part, **values)


def whole(**fields: Any) -> Change:
    return lambda system: changed(system, fields)


def first(**fields: Any) -> Change:
    """Change the rank's first subdomain."""
    return whole(subdomains=lambda given: [changed(given[0], fields), *given[1:]])


def held(**fields: Any) -> Change:
    """Change the prescribed displacements."""
    return whole(prescribed=lambda given: changed(given, fields))


def rows(**fields: Any) -> Change:
    """Change the contact rows."""
    return whole(contacts=lambda given: changed(given, fields))


def tied(**fields: Any) -> Change:
    """Tie the nodes of the contact along x, with some fields of the rows changed."""
    along_x = rows(coefficients=lambda c: c[:, ::-1])
    return lambda system: replace(
        system, tied=changed(along_x(system).contacts, fields) if fields else None
    )


def at(place: Any, value: Any) -> Callable[[Any], Any]:
    """Change one entry, or some."""

    def change(values: Any) -> Any:
        copy = np.array(values)
        copy[place] = value
        return copy

    return change


def entry(place: Any, value: float) -> Callable[[sp.csr_matrix], sp.csr_matrix]:
    """Change an array of a sparse matrix."""

    def change(K: sp.csr_matrix) -> sp.csr_matrix:
        copy = K.copy()
        getattr(copy, place)[-1] = value
        return copy

    return change


# -- mistakes in any system that has the part ------------------------------------------------------

SUBDOMAIN: list[Mistake] = [
    (first(body=-1), "body of subdomain 0", "-1", "from 0 on"),
    (first(body=1.0), "body of subdomain 0", "1.0", "integer"),
    (first(body=10**9), "body numbers", "1000000000", "without gaps"),
    (first(nodes=at(3, -5)), "nodes of subdomain 0", "1 of 64", "-5", "position 3"),
    (first(nodes=lambda n: [*n[:-1], n[0]]), "nodes of subdomain 0", "1 node numbers", "once"),
    (first(nodes=at(3, 2**63 - 1)), "nodes of subdomain 0", "1 of 64", "9223372036854775807"),
    (first(nodes=lambda n: n.astype(float)), "nodes of", "float64", "astype(numpy.int64)"),
    (first(nodes=lambda n: n[1:]), "coordinates of subdomain 0", "(64, 3)", "expected (63, 3)"),
    (first(load=lambda f: f[1:]), "load of subdomain 0", "(191,)", "expected (192,)"),
    (first(load=lambda f: f[None]), "load of subdomain 0", "(1, 192)", "expected (192,)"),
    (first(load=lambda f: f + 0j), "load of subdomain 0", "complex128", "float64"),
    (first(load=None), "load of subdomain 0", "NoneType", "(192,)"),
    (first(load=at(5, np.nan)), "load of subdomain 0", "1 of 192", "NaN", "traction"),
    (first(load_size=np.zeros(5)), "load_size of subdomain 0", "(5,)", "expected (192,)"),
    (first(coordinates=lambda x: x[:, 1:]), "coordinates of", "(64, 2)", "expected (64, 3)"),
    (first(coordinates=at((5, 1), np.inf)), "coordinates of subdomain 0", "1 of 192", "infinite"),
    (first(frame=np.eye(5)), "frame of subdomain 0", "(5, 5)", "expected (3, 3)"),
    (first(stiffness=lambda K: K.toarray()), "of shape (192, 192)", "csr_matrix(K)"),
    (first(stiffness=lambda K: K.toarray().tolist()), "stiffness of", "list", "csr_matrix(K)"),
    (first(stiffness=lambda K: K.tocoo()), "stiffness of subdomain 0", "coo", "tocsr()"),
    (first(stiffness=lambda K: K[3:, 3:]), "(189, 189)", "expected (192, 192)"),
    (first(stiffness=lambda K: K.astype("f")), "stiffness of", "float32", "astype(numpy.float64)"),
    (first(stiffness=entry("data", np.nan)), "stiffness of", "1 of", "NaN", "material"),
    (first(stiffness=entry("indices", 10**6)), "stiffness of", "not a valid csr matrix", "192"),
    (first(stiffness=lambda K: -K), "192 of 192 diagonal", "component 0", "positive moduli"),
    (whole(subdomains=lambda s: [vars(s[0])]), "subdomains[0]", "dict", "Subdomain"),
    (whole(subdomains=lambda s: s[0]), "subdomains", "Subdomain", "list"),
]
PRESCRIBED: list[Mistake] = [
    (held(components=at(0, -1)), "prescribed.components", "not in [0, 3)", "-1"),
    (held(components=at(0, 3)), "prescribed.components", "not in [0, 3)", "is 3"),
    (held(nodes=at(0, -1)), "prescribed.nodes", "-1", "position 0"),
    (held(nodes=at(0, 10**15)), "node 1000000000000000", "no subdomain"),
    (held(values=[[0.0]]), "prescribed.values", "(1, 1)", "expected (80,)"),
    (held(condition=[[0]]), "prescribed.condition", "(1, 1)", "expected (80,)"),
    (held(condition=at(0, -1)), "prescribed.condition", "not in [0, ", "-1"),
    (held(values=at(0, np.nan)), "prescribed displacements", "NaN"),
]
CONTACTS: list[Mistake] = [
    (rows(nodes=at(0, -1)), "contacts.nodes", "1 of 32", "-1", "position 0"),
    (rows(nodes=at(0, 10**15)), "node 1000000000000000", "no subdomain"),
    (rows(nodes=lambda n: n[:, None]), "contacts.nodes", "(32, 1)", "expected (k,)"),
    (rows(nodes=lambda n: n + 0.5), "contacts.nodes", "float64", "integers"),
    (rows(slaves=at(0, 9)), "contacts.slaves", "1 rows", "row 0 (joint)", "with 9"),
    (rows(offsets=at(0, 1)), "contacts.offsets", "from 1 to 32", "first has to be 0"),
    (rows(offsets=lambda n: n[:-1]), "contacts.offsets", "(16,)", "expected (17,)"),
    (rows(coefficients=[0.0, 0.0, -1.0]), "contacts.coefficients", "(3,)", "expected (32, 3)"),
    (rows(coefficients=at(4, np.nan)), "contacts.coefficients", "NaN"),
    (rows(gap=at(4, -np.inf)), "contacts.gap", "1 of 16", "NaN or -inf", "+inf"),
    (rows(gap=at(4, np.nan)), "contacts.gap", "1 of 16", "NaN"),
    (rows(held=lambda h: h.astype(int)), "contacts.held", "int64", "truth values", "numpy.bool"),
    (rows(held=lambda h: h[1:]), "contacts.held", "(15,)", "expected (16,)"),
    (rows(compliance=lambda c: c[1:]), "contacts.compliance", "(15, 2)", "expected (16, 2)"),
    (rows(compliance=at((4, 0), -1.0)), "compliance", "1 rows", "row 4 (joint)", "-1 where it pr"),
    (rows(compliance=at((4, 0), np.inf)), "compliance", "1 rows", "row 4 (joint)", "inf where it"),
    (rows(compliance=at((4, 1), np.nan)), "compliance", "1 rows", "nan where it pulls"),
    (rows(compliance=at((4, 1), 1.0), held=at(4, True)), "compliance", "1 rows that hold", "row 4"),
    (rows(compliance=at((4, 1), 1.0), gap=at(4, np.inf)), "compliance", "infinite gap", "row 4"),
    (rows(adhesion=at(4, -1.0)), "contacts.adhesion", "row 4 (joint)", "-1 N", "from 0 on"),
    (rows(adhesion=at(4, 1.0), held=at(4, True)), "adhesion", "1 rows with springs or", "row 4"),
    (rows(adhesion=at(4, 1.0), gap=at(4, np.inf)), "adhesion", "infinite gap", "row 4"),
    (rows(contact=at(4, -1)), "contacts.contact", "-1"),
    (rows(contact=at(4, 10**9)), "contacts.contact", "1000000000", "16 contact rows", "0, 1, ..."),
]
SYSTEM: list[Mistake] = [
    (whole(prescribed=None), "prescribed", "NoneType", "Prescribed()"),
    (whole(contacts=None), "contacts", "NoneType", "ContactRows.none"),
    (tied(), "tied", "NoneType", "ContactRows"),
    (whole(gdim=4), "gdim", "4", "2 or 3"),
    (whole(gdim=3.0), "gdim", "3.0", "2 or 3"),
    (whole(condition_names="clamped"), "condition_names", "str", "list of strings"),
    (whole(body_names="lower"), "body_names", "str", "list of strings"),
    (whole(contact_names=[1]), "contact_names", "int", "strings"),
]


def with_mistake(system: TornSystem, rng: np.random.Generator) -> TornSystem:
    """Make one of the mistakes that concern what this rank gives."""
    mistakes = SUBDOMAIN * bool(system.subdomains) + SYSTEM
    mistakes += PRESCRIBED * bool(system.prescribed.nodes.size)
    mistakes += CONTACTS * bool(system.contacts.nodes.size)
    for k in rng.permutation(len(mistakes)):
        try:
            return mistakes[k][0](system)
        except IndexError:  # there is no such entry
            continue
    raise AssertionError("those of SYSTEM can always be made")


# -- mistakes in the column ------------------------------------------------------------------------


def with_extra_cube(nodes_shared: int) -> Change:
    """Add a cube to the rank's first body that shares some nodes of a vertical edge."""

    def change(system: TornSystem) -> TornSystem:
        one = system.subdomains[0]
        extra = cube(3, (1, 1, 0), body=one.body, first=7 * 10**9)
        offset = np.array([0.0, 0.0, one.coordinates[:, 2].min()])
        coordinates = extra.coordinates + offset
        nodes = extra.nodes.copy()
        for k in range(nodes_shared):
            place = np.array([1.0, 1.0, k / 3]) + offset
            node = np.argmin(np.linalg.norm(coordinates - place, axis=1))
            nodes[node] = one.nodes[np.argmin(np.linalg.norm(one.coordinates - place, axis=1))]
        extra = replace(extra, nodes=nodes, coordinates=coordinates)
        return replace(system, subdomains=[*system.subdomains, extra])

    return change


def with_second_part(system: TornSystem) -> TornSystem:
    """Join a cube far away to the rank's first subdomain."""
    one, other = system.subdomains[0], cube(3, (0, 0, 7), first=7 * 10**9)
    both = Subdomain(
        sp.block_diag([one.stiffness, other.stiffness], format="csr"),
        np.concatenate([one.load, other.load]),
        np.concatenate([one.coordinates, other.coordinates]),
        np.concatenate([one.nodes, other.nodes]),
        one.body,
    )
    return replace(system, subdomains=[both, *system.subdomains[1:]])


def with_local_numbers(system: TornSystem) -> TornSystem:
    local = [replace(s, nodes=np.arange(s.nodes.size)) for s in system.subdomains]
    return replace(system, subdomains=local, prescribed=Prescribed(), contacts=ContactRows.none(3))


def without_cells(K: sp.csr_matrix) -> sp.csr_matrix:
    K = K.tolil()
    K[3:6, :] = 0.0
    K[:, 3:6] = 0.0
    return K.tocsr()


def skewed(K: sp.csr_matrix) -> sp.csr_matrix:
    return (K + sp.csr_matrix(([1e-3], ([0], [1])), shape=K.shape)).tocsr()


def nodes_twice(nodes: np.ndarray) -> np.ndarray:
    nodes = nodes.copy()
    nodes[[5, 9]] = nodes[[4, 8]]
    return nodes


NOTHING = {"nodes": [], "load": [], "coordinates": np.zeros((0, 3))}
VANISHES = "sum of the slave's coefficients vanishes in 1 rows"

MISTAKES: list[Mistake] = [
    *SUBDOMAIN,
    *PRESCRIBED,
    *CONTACTS,
    *SYSTEM,
    (first(**NOTHING, stiffness=sp.csr_matrix((0, 0))), "nodes of subdomain 0", "none", "out"),
    (first(frame=2 * np.eye(3)), "frame of subdomain 0", "|T T' - I| = 3.000e+00", "orthogonal"),
    (first(stiffness=skewed), "stiffness of subdomain 0", "not symmetric", "symmetric form"),
    (first(stiffness=without_cells), "stiffness of subdomain 0", "3 of 192 diagonal", "vertex"),
    (with_local_numbers, "glued nodes", "different places", "global"),
    (with_second_part, "stiffness of subdomain 0", "2 parts", "subdomain of its own"),
    (with_extra_cube(0), "er: 1 of its", "share no node", "body number of its own"),
    (with_extra_cube(1), "hinged", "share too few nodes", "3 that are not on a line"),
    (with_extra_cube(4), "hinged", "share too few nodes", "body number of its own"),
    (
        rows(nodes=nodes_twice),
        "contacts.nodes",
        "2 rows name a node twice",
        "row 2 (joint)",
        "Add up",
    ),
    (rows(nodes=lambda n: n[1:]), "contacts.offsets", "from 0 to 32", "31 nodes"),
    (rows(offsets=at(5, 6)), "not ascending", "from 8 to 6", "row 4 (joint)", "positions"),
    (rows(offsets=at(6, 10)), "1 rows have no terms", "row 5 (joint)", "Leave them out"),
    (
        rows(coefficients=at(8, [0, 0, 1e-13])),
        "contacts.coeff",
        VANISHES,
        "row 4 (joint)",
        "normal",
    ),
    (tied(gap=at(4, np.inf)), "tied.gap", "1 of 16", "NaN or infinite", "nothing to tie to"),
    (tied(nodes=nodes_twice), "tied.nodes", "2 rows name a node twice", "row 2 (joint)"),
    (tied(nodes=at(0, 777)), "node 777", "no subdomain"),
    (tied(coefficients=at(0, 0.0)), "tied.coefficients", VANISHES, "row 0 (joint)"),
    (tied(offsets=lambda n: n[:-1]), "tied.offsets", "(16,)", "expected (17,)"),
    (tied(contact=at(4, 10**9)), "tied.contact", "1000000000", "0, 1, ..."),
]
