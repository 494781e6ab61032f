"""Facets of single cells: their nodes, quadrature, outward normals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import scipy.sparse as sp

import basix
from dolfinx.fem import FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.geometry.reference_cells import (
    ReferenceCell,
    lagrange_points,
    quadrature,
    reference_cell,
    shape_gradients,
    shape_values,
)
from fenics_tfeti.fem.geometry.vectors import cross
from fenics_tfeti.fem.topology import cell_facets, cell_type
from fenics_tfeti.typing import Indices, Numbers, Vector


@dataclass(frozen=True)
class FacetRule:
    """Quadrature on the f facets of a reference cell, with the traces of the shape functions."""

    points: Vector  # (f, q, d)
    weights: Vector  # (q,)
    traces: Vector  # (f, q, t): shape functions of a facet's nodes
    normals: Vector  # (f, d): outward, as long as the facet is large

    @staticmethod
    @cache
    def of(name: str, degree: int, order: int) -> FacetRule:
        """Return a rule for polynomials of an order on facets with nodes of a degree."""
        kind = reference_cell(name)
        x, weights = quadrature(kind.facet.name, order)
        corners = np.asarray(basix.geometry(getattr(basix.CellType, name)))
        outward = np.asarray(basix.cell.facet_outward_normals(getattr(basix.CellType, name)))
        points, traces, normals = [], [], []
        x = x.reshape(weights.size, -1)
        for number, vertices in enumerate(kind.facets):
            edges = corners[list(vertices[1 : kind.dim])] - corners[vertices[0]]
            size = np.linalg.norm(edges[0] if kind.dim == 2 else np.cross(*edges))
            points.append(corners[vertices[0]] + x @ edges)
            values = shape_values(name, degree, points[-1])
            traces.append(values[:, list(kind.facet_nodes(degree)[number])])
            normals.append(outward[number] * size)
        return FacetRule(np.array(points), weights, np.array(traces), np.array(normals))


def add_rows(total: Vector, rows: Numbers | Indices, values: Vector) -> None:
    """Add values (k, ...) to some rows (k,) of a total; faster than NumPy's ``add.at``."""
    ends, ones = np.arange(rows.size + 1), np.ones(rows.size)
    summation = sp.csr_matrix((ones, rows, ends), (rows.size, len(total))).T
    columns = values.reshape(rows.size, int(np.prod(total.shape[1:])))
    total += (summation @ columns).reshape(total.shape)


class CellFaces:
    """The k cells of deformable bodies that this rank owns, each with its facets.

    `cells` are their numbers; other arrays have a row for each of them. Moments of forces are about
    the places of nodes after displacements `moves` (k, n, d) [m], if there are any.
    """

    def __init__(self, space: FunctionSpace, cells: Indices, moves: Vector | None = None) -> None:
        domain = space.mesh
        self.space, self.cells = space, cells
        self.kind: ReferenceCell = cell_type(domain)
        self.dim, self.degree = self.kind.dim, _compat.element_facts(space)[1]
        order = 2 * self.degree
        # loads and pressures, and stresses on facets: those of flat ones are polynomials
        self.rule = FacetRule.of(self.kind.name, self.degree, order + 4)
        self.closure: Numbers = np.array(self.kind.facet_nodes(self.degree))  # (f, t)
        self.corners: Numbers = np.array(self.kind.facet_nodes(1))  # (f, v)
        self.nodes: Indices = _compat.cell_dofs(space)[cells]  # (k, n): local nodes
        self.facets: Indices = cell_facets(domain)[cells]  # (k, f): local facets
        self.geometry_degree, self._moves = _compat.geometry_degree(domain), moves
        self._is_affine = self.kind.is_simplex and self.geometry_degree == 1
        self.stress_rule = (
            FacetRule.of(self.kind.name, self.degree, order) if self._is_affine else self.rule
        )

    @property
    def size(self) -> int:
        """The number of cells."""
        return int(self.cells.size)

    @cached_property
    def node_count(self) -> int:
        """The number of nodes that this rank has, ghosts included."""
        index_map = self.space.dofmap.index_map
        return int(index_map.size_local + index_map.num_ghosts)

    @cached_property
    def node_rule(self) -> FacetRule:
        """The nodes of facets as a rule, with equal weights."""
        points = lagrange_points(self.kind.name, self.degree)[self.closure]
        f, t = self.closure.shape
        traces = np.broadcast_to(np.eye(t), (f, t, t))
        return FacetRule(points, np.full(t, 1.0 / t), traces, self.rule.normals)

    def facet_nodes(self, rows: Numbers | slice = slice(None)) -> Indices:
        """Return the local nodes (k, f, t) of the facets of some of the cells."""
        return self.nodes[rows][:, self.closure]

    def nodes_at(self, facets: tuple[Numbers, ...]) -> Indices:
        """Return the local nodes (m, t) of facets: numbers of cells (m,), and in these (m,)."""
        k, f = facets
        return self.nodes[k[:, None], self.closure[f]]

    def corners_at(self, facets: tuple[Numbers, ...]) -> Indices:
        """Return the local nodes (m, v) at the vertices of facets."""
        k, f = facets
        return self.nodes[k[:, None], self.corners[f]]

    def points(self, reference: Vector, rows: Numbers | slice = slice(None)) -> Vector:
        """Return the places (k, q, d) of points of the reference cell [m]."""
        shapes = shape_values(self.kind.name, self.geometry_degree, reference)
        return np.asarray(np.matmul(shapes, self._coordinates(rows)))

    def node_points(self, degree: int, rows: Numbers | slice = slice(None)) -> Vector:
        """Return the places (k, n, d) of the nodes of a degree, moved if they do [m]."""
        reference = lagrange_points(self.kind.name, degree)
        places = self.points(reference, rows)
        if self._moves is None:
            return places
        moves = shape_values(self.kind.name, self.degree, reference) @ self._moves[rows]
        return np.asarray(places + moves)

    def weighted_normals(
        self, rows: Numbers | slice = slice(None), rule: FacetRule | None = None
    ) -> Vector:
        """Return the outward normals n dS (k, f, q, d) at the points of a rule on the facets."""
        x, rule = self._coordinates(rows), rule or self.rule
        weighted = []
        if self._is_affine:
            J = self._jacobians(x, rule.points[0, :1])
        for points, normal in zip(rule.points, rule.normals, strict=True):
            if not self._is_affine:
                J = self._jacobians(x, points)
            normals = _along_areas(J, normal)
            weighted.append(normals * rule.weights[:, None])
        return np.stack(weighted, axis=1)

    def volumes(self) -> Vector:
        """Return the volumes (k,) of the cells, or their areas [m^d]."""
        points, weights = quadrature(self.kind.name, 2 * self.geometry_degree * self.dim)
        J = self._jacobians(self._coordinates(slice(None)), points)
        return np.asarray(np.abs(np.linalg.det(J)) @ weights)

    def _coordinates(self, rows: Numbers | slice) -> Vector:
        geometry = self.space.mesh.geometry
        nodes = _compat.geometry_cells(self.space.mesh)[self.cells[rows]]
        return np.asarray(geometry.x[nodes][..., : self.dim])

    def _jacobians(self, x: Vector, points: Vector) -> Vector:
        """Return the derivatives (k, q, d, d) of places by coordinates of the reference cell."""
        gradients = shape_gradients(self.kind.name, self.geometry_degree, points)
        return np.stack([np.matmul(D, x) for D in gradients], axis=-1)


def _along_areas(J: Vector, normal: Vector) -> Vector:
    """Return n dS (..., d) for derivatives J (..., d, d) of places, by that of the reference cell.

    It is |det J| J^{-T} normal, by the cofactors of J.
    """
    if J.shape[-1] == 2:
        (a, b), (c, e) = np.moveaxis(J, (-2, -1), (0, 1))
        det = a * e - b * c
        turned = np.stack([e * normal[0] - c * normal[1], a * normal[1] - b * normal[0]], axis=-1)
        return np.asarray(np.sign(det)[..., None] * turned)
    columns = [J[..., k] for k in range(3)]
    crossed = [cross(columns[k - 2], columns[k - 1]) for k in range(3)]
    det = np.sum(columns[0] * crossed[0], axis=-1)
    turned = sum(crossed[k] * normal[k] for k in range(3))
    return np.asarray(np.sign(det)[..., None] * turned)
