"""Input decks of Abaqus and CalculiX: nodes, elements, sets and surfaces."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.io.mesh_sets import MeshSets
from fenics_tfeti.typing import Numbers

_log = logging.getLogger(__name__)

# Families of elements: their kinds by the number of nodes, and the corners of their numbered faces.
_SOLID = re.compile(r"C3D(4|8|10|20|6|15)(?!\d)")
_PLANE = re.compile(r"(?:CPS|CPE|CPEG|CAX|CGAX|M3D|SFM3D|R3D|S|STRI|DS)(3|4|6|8|9|65)(?!\d)")
_SOLIDS = {
    4: "tetra",
    8: "hexahedron",
    10: "tetra10",
    20: "hexahedron20",
    6: "wedge",
    15: "wedge15",
}
_PLANES = {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}
_LINES = {"T2D2": "line", "T3D2": "line", "T2D3": "line3", "T3D3": "line3"}
_FACES = {
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tetra": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "hexahedron": (
        *((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1)),
        *((1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
    ),
}
# the lines of surfaces of elements: a set or an element, and a face
_FACE = re.compile(r"S([1-6])")
# sets that Gmsh makes of its entities, beside those of physical groups
_ENTITY = re.compile(r"(Line|Surface|Volume)\d+")


@dataclass
class _Deck:
    """The data that the lines of a deck have given so far."""

    nodes: dict[int, list[float]] = field(default_factory=dict)
    elements: dict[int, tuple[str, list[int]]] = field(default_factory=dict)  # number: kind, nodes
    node_sets: dict[str, list[int]] = field(default_factory=dict)
    element_sets: dict[str, list[int]] = field(default_factory=dict)
    surfaces: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    surfaces_of_nodes: dict[str, list[str]] = field(default_factory=dict)
    instances: int = 0


def read_deck(path: Path) -> MeshSets:
    """Read the mesh of a deck (.inp), on one rank.

    Sets are those of ``*NODE``, ``*ELEMENT``, ``*NSET``, ``*ELSET`` and ``*SURFACE``; names have no
    case. Gmsh's sets of entities are left out where there are others, and so are other keywords.
    `InputError` with the line that cannot be read.
    """
    deck = _Deck()
    for place, keyword, options, lines in _blocks(path):
        try:
            _read_block(deck, place, keyword, options, lines)
        except InputError:
            raise
        except (ValueError, KeyError, IndexError) as error:
            what = error.args[0] if isinstance(error, KeyError) else error
            raise InputError(f"{place}: *{keyword} cannot be read ({what})") from error
    if len(others := [name for name in deck.element_sets if not _ENTITY.fullmatch(name)]):
        deck.element_sets = {name: deck.element_sets[name] for name in others}
    if not deck.elements:
        raise InputError(f"{path} has no elements of bodies (*ELEMENT)")
    return _mesh_sets(path, deck)


Block = tuple[str, str, dict[str, str], list[list[str]]]


def _blocks(path: Path) -> Iterator[Block]:
    """Yield the place of each keyword, the keyword, its options and the fields of its lines."""
    block: Block | None = None
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        if not line.strip() or line.startswith("**"):
            continue
        fields = [part.strip() for part in line.strip().split(",")]
        if not line.startswith("*"):
            if block:
                block[3].append(fields)
            continue
        if block:
            yield block
        pairs = (part.partition("=") for part in fields[1:] if part)
        options = {name.strip().upper(): value.strip().strip('"') for name, _, value in pairs}
        keyword = " ".join(fields[0][1:].upper().split())
        block = f"{path}, line {number}", keyword, options, []
        if keyword == "INCLUDE":
            yield from _blocks(path.parent / options["INPUT"])
            block = None
    if block:
        yield block


def _read_block(
    deck: _Deck, place: str, keyword: str, options: dict[str, str], lines: list[list[str]]
) -> None:
    """Add the lines of a keyword."""
    if keyword == "NODE":
        places = {int(line[0]): [*map(float, line[1:4]), 0.0, 0.0][:3] for line in lines}
        deck.nodes |= places
        _add(deck.node_sets, options.get("NSET"), [*places])
    elif keyword == "ELEMENT":
        kind, count = _kind(options["TYPE"].upper())
        if kind is None:
            _log.warning("%s: left out elements of the type %s", place, options["TYPE"])
            return
        # records may go on in the next line
        entries = np.array([int(entry) for line in lines for entry in line if entry])
        records = entries.reshape(-1, count + 1).tolist()
        if again := [record[0] for record in records if record[0] in deck.elements]:
            raise InputError(
                f"{place}: element {again[0]} is there twice. Decks with several parts are not "
                "read: write one without parts and instances ('Do not use parts and assemblies in "
                "input files' in Abaqus/CAE)"
            )
        # the second node of three on a line is the middle one
        order = (0, 2, 1) if kind == "line3" else range(count)
        deck.elements |= {number: (kind, [nodes[k] for k in order]) for number, *nodes in records}
        _add(deck.element_sets, options.get("ELSET"), [record[0] for record in records])
    elif keyword in ("NSET", "ELSET"):
        sets = deck.node_sets if keyword == "NSET" else deck.element_sets
        _add(sets, options[keyword], _members(sets, lines, "GENERATE" in options))
        if keyword == "NSET" and "ELSET" in options:
            elements = _named(deck.element_sets, options["ELSET"])
            nodes = [n for element in elements for n in deck.elements[element][1]]
            _add(sets, options["NSET"], nodes)
    elif keyword == "SURFACE" and options.get("TYPE", "ELEMENT").upper() == "ELEMENT":
        rows = [(line[0], line[1].upper() if len(line) > 1 else "") for line in lines]
        deck.surfaces.setdefault(options["NAME"], []).extend(rows)
    elif keyword == "SURFACE" and options["TYPE"].upper() == "NODE":
        deck.surfaces_of_nodes.setdefault(options["NAME"], []).extend(line[0] for line in lines)
    elif keyword == "INSTANCE":
        deck.instances += 1
        if lines or deck.instances > 1:
            raise InputError(
                f"{place}: instances that are moved, or several of them, are not read: write a "
                "deck without parts and instances ('Do not use parts and assemblies in input "
                "files' in Abaqus/CAE)"
            )


def _kind(name: str) -> tuple[str | None, int]:
    """Return the kind of an element of a type, None for those of no body, and its nodes."""
    if name in _LINES:
        return _LINES[name], int(name[-1])
    if found := _SOLID.match(name):
        return _SOLIDS[int(found[1])], int(found[1])
    if found := _PLANE.match(name):
        count = 6 if found[1] == "65" else int(found[1])
        return _PLANES[count], count
    return None, 0


def _key(sets: dict[str, list[int]], name: str) -> str:
    """Return how a set is written that is called so in any case, or the name of a new one."""
    return next((key for key in sets if key.upper() == name.upper()), name)


def _add(sets: dict[str, list[int]], name: str | None, members: Sequence[int]) -> None:
    if name is not None:
        sets.setdefault(_key(sets, name), []).extend(members)


def _members(sets: dict[str, list[int]], lines: list[list[str]], generate: bool) -> list[int]:
    """Return the numbers that the lines of a set name, one by one, by ranges or by other sets."""
    if generate:
        ends = [[int(n) for n in line if n] for line in lines]
        return [n for a, b, *step in ends for n in range(a, b + 1, *step)]
    return [n for line in lines for entry in line if entry for n in _named(sets, entry)]


def _named(sets: dict[str, list[int]], entry: str) -> list[int]:
    return [int(entry)] if entry.isdigit() else sets[_key(sets, entry)]


def _mesh_sets(path: Path, deck: _Deck) -> MeshSets:
    """Return the arrays of a deck."""
    labels = np.array(sorted(deck.nodes), dtype=np.int64)
    row = {label: k for k, label in enumerate(labels.tolist())}
    kinds = list(dict.fromkeys(kind for kind, _ in deck.elements.values()))
    ordered = [n for kind in kinds for n, (other, _) in deck.elements.items() if other == kind]
    number = {element: k for k, element in enumerate(ordered)}
    try:
        blocks = [
            (
                kind,
                np.array(
                    [[row[n] for n in nodes] for k, nodes in deck.elements.values() if k == kind]
                ),
            )
            for kind in kinds
        ]
    except KeyError as error:
        raise InputError(
            f"{path}: an element has the node {error.args[0]}, which is not there"
        ) from error
    # sets may have elements that are left out, such as springs, and nodes of none
    nodes = {
        name: np.array([row[n] for n in members if n in row], dtype=np.int64)
        for name, members in deck.node_sets.items()
    }
    for name, entries in deck.surfaces_of_nodes.items():
        chosen = [n for entry in entries for n in _named(deck.node_sets, entry) if n in row]
        nodes[name] = np.array([row[n] for n in chosen], dtype=np.int64)
    return MeshSets(
        path,
        np.array([deck.nodes[label] for label in labels.tolist()]),
        blocks,
        {
            name: np.array([number[n] for n in members if n in number], dtype=np.int64)
            for name, members in deck.element_sets.items()
        },
        nodes,
        {name: _facets(path, deck, name, row) for name in deck.surfaces},
    )


def _facets(path: Path, deck: _Deck, name: str, row: dict[int, int]) -> Numbers:
    """Return the corners (f, t) of the facets of a surface of elements."""
    facets = []
    for entry, face in deck.surfaces[name]:
        try:
            elements = _named(deck.element_sets, entry)
        except KeyError:
            raise InputError(
                f"{path}: the surface {name!r} is of the set {entry!r} of elements, which is not "
                "there"
            ) from None
        for kind, nodes in (deck.elements[n] for n in elements if n in deck.elements):
            faces = _FACES.get(re.sub(r"\d+$", "", kind), ())
            which = _FACE.fullmatch(face)
            if which is None or int(which[1]) > len(faces):
                raise InputError(
                    f"{path}: the surface {name!r} has the face {face or 'of no number'!r} of an "
                    f"element of {len(nodes)} nodes; S1 to S{len(faces)} are read"
                )
            facets.append([row[nodes[k]] for k in faces[int(which[1]) - 1]])
    return np.array(facets, dtype=np.int64)
