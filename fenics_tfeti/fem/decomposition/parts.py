"""Subdomains as parts of the user's mesh, with equal node numbers where congruent."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from dolfinx.fem import FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.assembly_loops import add_matrices, block_format, neighbours_of_nodes
from fenics_tfeti.fem.decomposition.images import find_images
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING, RELATIVE_ROUNDING
from fenics_tfeti.typing import Array, Indices, Numbers, Vector


@dataclass(frozen=True)
class BlockPattern:
    """The nonzero blocks of a stiffness matrix, between nodes of common cells."""

    table: Indices  # (m, v) nodes of each cell
    ends: Indices  # (nodes + 1,) of each node's neighbours
    neighbours: Indices  # ascending, each node among its own
    indptr: Indices  # of the CSR format, unknowns node by node
    indices: Indices

    @staticmethod
    def of(table: Indices, nodes: int, size: int) -> BlockPattern:
        """Return the pattern of cells with nodes in a table (m, v), and blocks of a size."""
        ends, neighbours = neighbours_of_nodes(table, nodes)
        return BlockPattern(table, ends, neighbours, *block_format(ends, neighbours, size))

    def add(self, data: Vector, cells: Numbers | slice, matrices: Vector) -> None:
        """Add the matrices of some cells to the data of the matrix."""
        add_matrices(self.table[cells], self.ends, self.neighbours, matrices, data)

    def matrix(self, data: Vector) -> sp.csr_matrix:
        """Return the matrix with these data."""
        size = self.indptr.size - 1
        return sp.csr_matrix((data, self.indices, self.indptr), (size, size))


@dataclass(frozen=True)
class Part:
    """The m cells of a subdomain, and the numbers of their k nodes within it."""

    cells: Indices
    nodes: Indices  # (k,) blocked degrees of freedom of the user's space
    table: Indices  # (m, v) nodes of each cell, numbered within the subdomain
    body: int
    # Hash of the table and of the nodes' relative coordinates, equal for congruent parts; None
    # where no other part has as many cells and nodes.
    shape: bytes | None = None
    # Orthogonal matrix T (d, d) if the part is the image, rotated or mirrored by T, of another one
    # of this shape.
    rotation: Vector | None = None

    patterns: dict[int, BlockPattern] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def pattern(self, size: int) -> BlockPattern:
        """Return the pattern of the stiffness matrix, which is kept to assemble it again."""
        if size not in self.patterns:
            self.patterns[size] = BlockPattern.of(self.table, self.nodes.size, size)
        return self.patterns[size]


def number_parts(
    space: FunctionSpace, cells: Sequence[Indices], bodies: Sequence[int], x: Vector | None = None
) -> list[Part]:
    """Give the nodes of each subdomain numbers within it.

    Where parts have equally many cells and nodes, both are sorted in an order that depends on their
    shape alone: congruent parts have equal tables. Rotated and mirrored parts have the order of the
    first one of their shape; their cells have the same nodes, in any order. `x` are the coordinates
    (dofs, 3) of the blocked degrees of freedom [m], where they are known.
    """
    dofs = _compat.cell_dofs(space)
    x = (space.tabulate_dof_coordinates() if x is None else x)[:, : space.mesh.geometry.dim]
    number = np.empty(len(x), dtype=np.int32)
    parts = [
        _number(dofs, part_cells, body, number)
        for part_cells, body in zip(cells, bodies, strict=True)
    ]
    same_sizes: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, part in enumerate(parts):
        same_sizes[part.cells.size, part.nodes.size].append(i)
    for candidates in same_sizes.values():
        if len(candidates) > 1:
            for i in candidates:
                parts[i] = _sort(parts[i], x[parts[i].nodes])
            _align_images(parts, candidates, x)
    return parts


def find_equal(
    parts: Sequence[Part],
    x: Vector,
    data: Sequence[Array],
    translation_invariant: bool,
    matrices: Mapping[int, Vector],
) -> list[int]:
    """Return for each part the first one that is equal to it in shape and data, possibly itself.

    `x` are the coordinates (dofs, gdim) [m], `data` arrays (cells, ...) that have to be equal, bit
    by bit, `matrices` those of sample cells of parts, see `samples`, in the frame of their shapes:
    where parts are rotated differently, they have to be equal. Without invariance to translations
    no two parts are equal, since they lie at different places.
    """
    first = list(range(len(parts)))
    if not translation_invariant:
        return first
    earlier: dict[bytes, list[int]] = defaultdict(list)
    for i, part in enumerate(parts):
        if part.shape is None:
            continue
        # the hash stands for the data; coordinates are rounded in it and therefore compared
        candidates = earlier[part.shape + _hash(*(values[part.cells] for values in data))]
        for j in candidates:
            same_rotation = part.rotation is parts[j].rotation or _is_equal(
                matrices[i], matrices[j]
            )
            if same_rotation and _is_translated(_in_frame(part, x), _in_frame(parts[j], x)):
                first[i] = j
                break
        else:
            candidates.append(i)
    return first


def samples(parts: Sequence[Part], data: Sequence[Array]) -> dict[int, Numbers]:
    """Choose cells that tell whether rotated parts have rotated stiffness matrices.

    Return, for each part of a shape that also occurs rotated, positions among its cells: one cell
    for each combination of data, and all cells with data that differ within the cell, since cells
    of images may have their nodes in another order.
    """
    rotated = {part.shape for part in parts if part.rotation is not None}
    positions = {}
    for i, part in enumerate(parts):
        if part.shape in rotated:
            part_data = [values[part.cells].reshape(part.cells.size, -1) for values in data]
            differ = np.zeros(part.cells.size, dtype=bool)
            for values in part_data:
                differ |= (values != values[:, :1]).any(axis=1)
            number = np.where(differ, np.arange(differ.size), -1)[:, None]
            rows = [np.ascontiguousarray(values).view(np.uint8) for values in (number, *part_data)]
            positions[i] = np.unique(np.hstack(rows), axis=0, return_index=True)[1]
    return positions


def _align_images(parts: list[Part], candidates: Sequence[int], x: Vector) -> None:
    """Give parts that are images of earlier ones the order of these, and their matrices."""
    images: dict[bytes | None, Part] = {}
    shapes, sizes = list[Part](), list[Vector]()
    for i in candidates:
        part = parts[i]
        if part.shape not in images:
            # most parts that are no images have other sizes
            size = _sizes(x[part.nodes])
            difference = np.abs(np.array(sizes).reshape(-1, size.size) - size).max(axis=1)
            similar = np.flatnonzero(difference <= RELATIVE_ROUNDING * size.max())
            aligned = (_image(part, shapes[j], x) for j in similar)
            image = next((image for image in aligned if image is not None), None)
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


def _sizes(x: Vector) -> Vector:
    """Return mean, root mean square and largest distance of points from their centre."""
    radii = np.linalg.norm(x - x.mean(axis=0), axis=1)
    return np.array([radii.mean(), np.sqrt(np.mean(radii**2)), radii.max()])


def _image(part: Part, reference: Part, x: Vector) -> Part | None:
    """Return a part in the order of another one that it is the image of, as positions."""
    reference_rows = np.sort(reference.table, axis=1)
    reference_order = np.lexsort(reference_rows.T)
    for rotation, order in find_images(x[part.nodes], x[reference.nodes]):
        table = _inverse(order)[part.table]
        sorted_rows = np.sort(table, axis=1)
        row_order = np.lexsort(sorted_rows.T)
        if np.array_equal(sorted_rows[row_order], reference_rows[reference_order]):
            cells = row_order[_inverse(reference_order)].astype(np.int32)
            return Part(
                cells, order.astype(np.int32), table[cells], part.body, reference.shape, rotation
            )
    return None


def _in_frame(part: Part, x: Vector) -> Vector:
    points = x[part.nodes]
    return points if part.rotation is None else points @ part.rotation


def _is_equal(a: Vector, b: Vector) -> bool:
    """Tell whether matrices differ by no more than rounding."""
    return bool(np.abs(a - b).max() <= RELATIVE_ROUNDING * np.abs(a).max())


def _number(dofs: Indices, cells: Indices, body: int, number: Indices) -> Part:
    """Return a part with its nodes numbered; `number`, for all nodes of the space, is scratch."""
    table = dofs[cells]
    nodes = np.unique(table)
    # several times faster than the inverse that np.unique returns
    number[nodes] = np.arange(nodes.size, dtype=np.int32)
    return Part(cells, nodes, number[table], body)


def _sort(part: Part, x: Vector) -> Part:
    """Sort the nodes by their coordinates relative to the part, and the cells by their nodes."""
    # Coordinates are rounded to steps in the width of the part. Their number is a power of two, so
    # that no regular grid has nodes half-way between two steps; a part whose node is there by
    # chance is assembled by itself.
    steps = 2**30
    relative = x - x.min(axis=0)
    rounded = np.rint(relative * (steps / relative.max())).astype(np.int64)
    order = np.lexsort(rounded.T)
    table = _inverse(order)[part.table]
    rows = _order_of_rows(table, order.size)
    shape = _hash(rounded[order], table[rows])
    return Part(part.cells[rows], part.nodes[order], table[rows], part.body, shape)


def _inverse(order: Array) -> Indices:
    """Return the inverse of a permutation."""
    position = np.empty(order.size, dtype=np.int32)
    position[order] = np.arange(order.size, dtype=np.int32)
    return position


def _order_of_rows(table: Indices, numbers: int) -> NDArray[np.intp]:
    """Return the order of rows of numbers below `numbers` < 2^31, by the last column first."""
    # two columns to a key halve the time
    keys, second = table[:, ::-2].astype(np.int64), table[:, -2::-2]
    keys[:, : second.shape[1]] *= numbers
    keys[:, : second.shape[1]] += second
    return np.lexsort(keys[:, ::-1].T)


def _hash(*data: Array) -> bytes:
    digest = hashlib.sha256()
    for values in data:
        digest.update(f"{values.dtype} {values.shape}".encode())
        digest.update(values.tobytes())
    return digest.digest()


def _is_translated(a: Vector, b: Vector) -> bool:
    """Tell whether two parts' nodes differ by a translation, up to the rounding of coordinates."""
    offset = a - b
    offset -= offset[:1]
    largest = max(np.abs(a).max(), np.abs(b).max())
    return bool(np.abs(offset).max() <= COORDINATE_ROUNDING * largest)
