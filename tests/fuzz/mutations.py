"""Torn systems that are wrong on purpose: every one has to be refused, on all ranks alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.random import Generator
from torn_problems import TornProblem

__all__ = ["MUTATIONS", "mutated"]

Change = Callable[[TornProblem, Generator], TornProblem]
MUTATIONS: dict[str, Change] = {}


def mutated(problem: TornProblem, rng: Generator) -> TornProblem:
    """Make a problem wrong in one of the ways that it offers."""
    while True:
        name = str(rng.choice(list(MUTATIONS)))
        try:
            changed = MUTATIONS[name](problem, rng)
        except IndexError:  # there is no such thing as was to be made wrong
            continue
        story = [*problem.story, f"made wrong: {name}"]
        return replace(changed, mutation=name, story=story)


def _register(change: Change) -> Change:
    MUTATIONS[change.__name__.replace("_", " ")] = change
    return change


def _in_subdomain(problem: TornProblem, rng: Generator, **values: Any) -> TornProblem:
    subdomains = list(problem.subdomains)
    k = int(rng.integers(len(subdomains)))
    of_one = {name: value(subdomains[k]) for name, value in values.items()}
    subdomains[k] = replace(subdomains[k], **of_one)
    return replace(problem, subdomains=subdomains)


def _with(array: Any, rng: Generator, value: Any) -> Any:
    """Return a copy with one entry changed; IndexError if there is none."""
    changed = np.array(array)
    changed.reshape(-1)[int(rng.integers(changed.size)) if changed.size else 0] = value
    return changed


def _in_rows(problem: TornProblem, rng: Generator, name: str, value: Any) -> TornProblem:
    changed = {name: _with(getattr(problem.contacts, name), rng, value)}
    return replace(problem, contacts=replace(problem.contacts, **changed))


def _in_prescribed(problem: TornProblem, rng: Generator, name: str, value: Any) -> TornProblem:
    changed = {name: _with(getattr(problem.prescribed, name), rng, value)}
    return replace(problem, prescribed=replace(problem.prescribed, **changed))


@_register
def load_is_nan(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_subdomain(problem, rng, load=lambda s: _with(s.load, rng, np.nan))


@_register
def coordinate_is_infinite(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_subdomain(problem, rng, coordinates=lambda s: _with(s.coordinates, rng, np.inf))


@_register
def load_is_too_short(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_subdomain(problem, rng, load=lambda s: s.load[:-1])


@_register
def coordinates_have_a_column_more(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_subdomain(
        problem, rng, coordinates=lambda s: np.column_stack([s.coordinates, s.coordinates[:, 0]])
    )


@_register
def node_is_negative(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_subdomain(problem, rng, nodes=lambda s: _with(s.nodes, rng, -3))


@_register
def node_is_twice_in_a_subdomain(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_subdomain(problem, rng, nodes=lambda s: np.append(s.nodes[:-1], s.nodes[0]))


@_register
def body_is_negative(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_subdomain(problem, rng, body=lambda s: -1)


@_register
def body_number_leaves_a_gap(problem: TornProblem, rng: Generator) -> TornProblem:
    subdomains = [replace(s, body=s.body + 1) for s in problem.subdomains]
    return replace(problem, subdomains=subdomains)


@_register
def stiffness_is_nan(problem: TornProblem, rng: Generator) -> TornProblem:
    def change(s: Any) -> Any:
        K = s.stiffness.copy()
        K.data[int(rng.integers(K.nnz))] = np.nan
        return K

    return _in_subdomain(problem, rng, stiffness=change)


@_register
def stiffness_is_not_symmetric(problem: TornProblem, rng: Generator) -> TornProblem:
    def change(s: Any) -> Any:
        skew = sp.csr_matrix(([abs(s.stiffness).max()], ([0], [1])), shape=s.stiffness.shape)
        return (s.stiffness + skew).tocsr()

    return _in_subdomain(problem, rng, stiffness=change)


@_register
def stiffness_is_negative(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_subdomain(problem, rng, stiffness=lambda s: -s.stiffness)


@_register
def stiffness_is_too_small(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_subdomain(problem, rng, stiffness=lambda s: s.stiffness[:-1][:, :-1])


@_register
def there_are_no_subdomains(problem: TornProblem, rng: Generator) -> TornProblem:
    return replace(problem, subdomains=[])


@_register
def component_is_negative(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_prescribed(problem, rng, "components", -1)


@_register
def component_is_too_large(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_prescribed(problem, rng, "components", problem.glued.gdim)


@_register
def prescribed_value_is_nan(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_prescribed(problem, rng, "values", np.nan)


@_register
def prescribed_node_is_unknown(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_prescribed(problem, rng, "nodes", int(problem.numbers.max()) + 5)


@_register
def gap_is_nan(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_rows(problem, rng, "gap", np.nan)


@_register
def gap_is_minus_infinity(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_rows(problem, rng, "gap", -np.inf)


@_register
def coefficient_of_a_slave_vanishes(problem: TornProblem, rng: Generator) -> TornProblem:
    changed = problem.contacts.coefficients.copy()
    changed[problem.contacts.offsets[_row(problem, rng)]] = 0.0
    return replace(problem, contacts=replace(problem.contacts, coefficients=changed))


@_register
def coefficient_is_nan(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_rows(problem, rng, "coefficients", np.nan)


@_register
def node_of_a_row_is_negative(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_rows(problem, rng, "nodes", -1)


@_register
def node_of_a_row_is_unknown(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_rows(problem, rng, "nodes", int(problem.numbers.max()) + 5)


@_register
def row_has_no_term(problem: TornProblem, rng: Generator) -> TornProblem:
    rows, k = problem.contacts, _row(problem, rng)
    without = np.delete(np.arange(rows.size), k)
    shortened = rows.chosen(without)
    changed = replace(
        rows,
        offsets=np.insert(shortened.offsets, k, shortened.offsets[k]),
        nodes=shortened.nodes,
        coefficients=shortened.coefficients,
    )
    return replace(problem, contacts=changed)


@_register
def contact_is_negative(problem: TornProblem, rng: Generator) -> TornProblem:
    return _in_rows(problem, rng, "contact", -1)


@_register
def node_is_twice_in_a_row(problem: TornProblem, rng: Generator) -> TornProblem:
    rows = problem.contacts
    paired = np.flatnonzero(np.diff(rows.offsets) > 1)
    k = paired[int(rng.integers(paired.size)) if paired.size else 0]
    nodes = rows.nodes.copy()
    nodes[rows.offsets[k] + 1] = nodes[rows.offsets[k]]
    return replace(problem, contacts=replace(rows, nodes=nodes))


def _row(problem: TornProblem, rng: Generator) -> int:
    """Return one of the contact rows; IndexError if there is none."""
    if not problem.contacts.size:
        raise IndexError
    return int(rng.integers(problem.contacts.size))
