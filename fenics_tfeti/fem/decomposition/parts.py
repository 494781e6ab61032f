"""The parts of the user's mesh that are subdomains, with equal node numbers where congruent."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.images import find_images
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING, RELATIVE_ROUNDING
from fenics_tfeti.typing import Indices, Points


@dataclass(frozen=True)
class Part:
    """The cells of a subdomain, and the numbers of their nodes within it.

    Attributes
    ----------
    cells : (m,) integer array
        The cells of the user's mesh.
    nodes : (k,) integer array
        Blocked degrees of freedom of the user's space, in the order of the subdomain's nodes.
    table : (m, v) integer array
        The nodes of each cell, numbered within the subdomain.
    body : int
        The body.
    shape : bytes or None
        Hash of the table and of the nodes' relative coordinates, equal for congruent parts; None
        where no other part has as many cells and nodes.
    turn : (d, d) array or None
        Orthogonal matrix T if the part is the image of another one of this shape, rotated or
        mirrored by T.
    """

    cells: Indices
    nodes: Indices
    table: Indices
    body: int
    shape: bytes | None = None
    turn: Points | None = None


def number_parts(
    space: FunctionSpace, cells: Sequence[Indices], bodies: Sequence[int], x: Points | None = None
) -> list[Part]:
    """Give the nodes of each subdomain numbers within it.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space.
    cells : sequence of integer arrays
        Cells of each of this rank's subdomains.
    bodies : sequence of int
        The body of each.
    x : (dofs, 3) array, optional
        Coordinates of the blocked degrees of freedom [m], where they are known.

    Returns
    -------
    list of Part
        Where parts have equally many cells and nodes, both are sorted in an order that depends on
        their shape alone: congruent parts have equal tables. Rotated and mirrored parts have the
        order of the first one of their shape; their cells have the same nodes, in any order.
    """
    dofs = _compat.cell_dofs(space)
    x = (space.tabulate_dof_coordinates() if x is None else x)[:, : space.mesh.geometry.dim]
    number = np.empty(len(x), dtype=np.int32)
    parts = [_number(dofs, own, body, number) for own, body in zip(cells, bodies, strict=True)]
    alike: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, part in enumerate(parts):
        alike[part.cells.size, part.nodes.size].append(i)
    for candidates in alike.values():
        if len(candidates) > 1:
            for i in candidates:
                parts[i] = _sort(parts[i], x[parts[i].nodes])
            _turn(parts, candidates, x)
    return parts


def find_equal(
    parts: Sequence[Part],
    x: Points,
    data: Sequence[NDArray[Any]],
    translation_invariant: bool,
    matrices: Mapping[int, Points],
) -> list[int]:
    """Find parts that are equal in shape and data.

    Parameters
    ----------
    parts : sequence of Part
        This rank's parts.
    x : (dofs, gdim) array
        Coordinates of the blocked degrees of freedom of the user's space [m].
    data : sequence of (cells, ...) arrays
        Data of each cell of the user's mesh that have to be equal, bit by bit.
    translation_invariant : bool
        False: no two parts are equal, since they lie at different places.
    matrices : dict of int to array
        Matrices of sample cells of parts, see `samples`, in the frame of their shapes. Where parts
        are turned differently, they have to be equal.

    Returns
    -------
    list of int
        For each part the first one that is equal to it, possibly itself.
    """
    first = list(range(len(parts)))
    if not translation_invariant:
        return first
    known: dict[bytes, list[int]] = defaultdict(list)
    for i, part in enumerate(parts):
        if part.shape is None:
            continue
        # the hash stands for the data; coordinates are rounded in it and therefore compared
        candidates = known[part.shape + _hash(*(values[part.cells] for values in data))]
        for j in candidates:
            same_turn = part.turn is parts[j].turn or _is_equal(matrices[i], matrices[j])
            if same_turn and _is_translated(_in_frame(part, x), _in_frame(parts[j], x)):
                first[i] = j
                break
        else:
            candidates.append(i)
    return first


def samples(parts: Sequence[Part], data: Sequence[NDArray[Any]]) -> dict[int, NDArray[np.int64]]:
    """Choose cells that tell whether turned parts have turned stiffness matrices.

    Parameters
    ----------
    parts : sequence of Part
        This rank's parts.
    data : sequence of (cells, ...) arrays
        Data by which the matrices of cells may differ.

    Returns
    -------
    dict of int to integer arrays
        For each part of a shape that is there turned, positions among its cells: one cell for each
        combination of data, and all cells with data that differ within the cell, since cells of
        images may have their nodes in another order.
    """
    turned = {part.shape for part in parts if part.turn is not None}
    chosen = {}
    for i, part in enumerate(parts):
        if part.shape in turned:
            own = [values[part.cells].reshape(part.cells.size, -1) for values in data]
            differ = np.zeros(part.cells.size, dtype=bool)
            for values in own:
                differ |= (values != values[:, :1]).any(axis=1)
            number = np.where(differ, np.arange(differ.size), -1)[:, None]
            rows = [np.ascontiguousarray(values).view(np.uint8) for values in (number, *own)]
            chosen[i] = np.unique(np.hstack(rows), axis=0, return_index=True)[1]
    return chosen


def _turn(parts: list[Part], candidates: Sequence[int], x: Points) -> None:
    """Give parts that are images of earlier ones the order of these, and their matrices."""
    images: dict[bytes | None, Part] = {}
    shapes, sizes = list[Part](), list[Points]()
    for i in candidates:
        part = parts[i]
        if part.shape not in images:
            # most parts that are no images have other sizes
            size = _sizes(x[part.nodes])
            near = np.abs(np.array(sizes).reshape(-1, size.size) - size).max(axis=1)
            alike = np.flatnonzero(near <= RELATIVE_ROUNDING * size.max())
            found = (_image(part, shapes[j], x) for j in alike)
            image = next((image for image in found if image is not None), None)
            if image is None:
                shapes.append(part)
                sizes.append(size)
                # positions of its own
                image = replace(
                    part,
                    cells=np.arange(part.cells.size, dtype=np.int32),
                    nodes=np.arange(part.nodes.size, dtype=np.int32),
                )
            images[part.shape] = image
        image = images[part.shape]
        parts[i] = replace(
            image, cells=part.cells[image.cells], nodes=part.nodes[image.nodes], body=part.body
        )


def _sizes(x: Points) -> Points:
    """Return mean, root mean square and largest distance of points from their centre."""
    radii = np.linalg.norm(x - x.mean(axis=0), axis=1)
    return np.array([radii.mean(), np.sqrt(np.mean(radii**2)), radii.max()])


def _image(part: Part, one: Part, x: Points) -> Part | None:
    """Return a part in the order of another one that it is the image of, as positions."""
    other = np.sort(one.table, axis=1)
    others = np.lexsort(other.T)
    for turn, order in find_images(x[part.nodes], x[one.nodes]):
        place = np.empty(order.size, dtype=np.int32)
        place[order] = np.arange(order.size, dtype=np.int32)
        table = place[part.table]
        own = np.sort(table, axis=1)
        rows = np.lexsort(own.T)
        if np.array_equal(own[rows], other[others]):
            cells = np.empty(rows.size, dtype=np.int32)
            cells[others] = rows
            return Part(cells, order.astype(np.int32), table[cells], part.body, one.shape, turn)
    return None


def _in_frame(part: Part, x: Points) -> Points:
    own = x[part.nodes]
    return own if part.turn is None else own @ part.turn


def _is_equal(one: Points, other: Points) -> bool:
    """Tell whether matrices differ by no more than rounding."""
    return bool(np.abs(one - other).max() <= RELATIVE_ROUNDING * np.abs(one).max())


def _number(dofs: Indices, cells: Indices, body: int, number: Indices) -> Part:
    """Return a part with its nodes numbered; `number`, for all nodes of the space, is scratch."""
    table = dofs[cells]
    nodes = np.unique(table)
    # several times faster than the inverse that np.unique returns
    number[nodes] = np.arange(nodes.size, dtype=np.int32)
    return Part(cells, nodes, number[table], body)


def _sort(part: Part, x: Points) -> Part:
    """Sort the nodes by their coordinates relative to the part, and the cells by their nodes."""
    # Coordinates are rounded to steps in the width of the part. Their number is a power of two, so
    # that no regular grid has nodes half-way between two steps; a part whose node is there by
    # chance is assembled by itself.
    steps = 2**30
    relative = x - x.min(axis=0)
    rounded = np.rint(relative * (steps / relative.max())).astype(np.int64)
    order = np.lexsort(rounded.T)
    rank = np.empty(order.size, dtype=np.int32)
    rank[order] = np.arange(order.size, dtype=np.int32)
    table = rank[part.table]
    rows = _order_of_rows(table, order.size)
    shape = _hash(rounded[order], table[rows])
    return Part(part.cells[rows], part.nodes[order], table[rows], part.body, shape)


def _order_of_rows(table: Indices, numbers: int) -> NDArray[np.intp]:
    """Return the order of rows of numbers below `numbers` < 2^31, by the last column first."""
    # two columns to a key halve the time
    keys, before = table[:, ::-2].astype(np.int64), table[:, -2::-2]
    keys[:, : before.shape[1]] *= numbers
    keys[:, : before.shape[1]] += before
    order: NDArray[np.intp] = np.lexsort(keys[:, ::-1].T)
    return order


def _hash(*data: NDArray[Any]) -> bytes:
    digest = hashlib.sha256()
    for values in data:
        digest.update(f"{values.dtype} {values.shape}".encode())
        digest.update(values.tobytes())
    return digest.digest()


def _is_translated(one: Points, other: Points) -> bool:
    """Tell whether two parts' nodes differ by a translation, up to the rounding of coordinates."""
    offset = one - other
    offset -= offset[:1]
    largest = max(np.abs(one).max(), np.abs(other).max())
    return bool(np.abs(offset).max() <= COORDINATE_ROUNDING * largest)
