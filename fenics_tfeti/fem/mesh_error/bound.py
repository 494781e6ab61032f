"""A strict bound of the error, by stresses in equilibrium with the loads and the contact pressures.

For displacements v that are admissible and stresses tau in equilibrium with the loads and pressures
p >= 0, |u - v|^2 <= |sigma(v) - tau|^2 + 2 (p, gap - v_n) (Prager and Synge). Tau is the composite
stress of Johnson and Mercier (Numer. Math. 30 (1978) 103): linear in the d + 1 simplices of a cell
and its centroid, with continuous tractions, it follows from the tractions on the cell's facets.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from itertools import combinations

from mpi4py import MPI

import numpy as np
from scipy.spatial import cKDTree

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.contact_set import FoundContact, FoundTie
from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair, RigidObstacle
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_tags
from fenics_tfeti.fem.contact.descriptions.ties import TiedPair
from fenics_tfeti.fem.geometry.reference_cells import quadrature, reference_cell, shape_values
from fenics_tfeti.fem.mesh_error.contact import distances_to_obstacle, tagged
from fenics_tfeti.fem.mesh_error.problem import MeshErrorProblem
from fenics_tfeti.fem.mesh_error.stress import has_stress
from fenics_tfeti.fem.mesh_error.tractions import over_ranks
from fenics_tfeti.typing import Numbers, Vector

# differences, relative to the largest number, that are rounding
_ROUNDING = 1e-8
# distances of nodes, relative to the mesh, at one place
_SAME_PLACE = 1e-9
# initial gaps that are those of surfaces that coincide
_OF_MESH = ("geometric", "touching")
# penetration, relative to the largest displacement, that is rounding
_PENETRATION = 1e-9


@dataclass
class StrictBound:
    """The bound, or the reasons why there is none."""

    reasons: tuple[str, ...]
    squares: Vector = field(default_factory=lambda: np.zeros(0))  # (k,) by cell [J]
    energies: Vector = field(default_factory=lambda: np.zeros(0))  # (k,) of the displacement [J]
    correction: float = 0.0  # distance of the admissible displacements from these [sqrt(J)]


def strict_bound(problem: MeshErrorProblem) -> StrictBound:
    """Bound the error, where all conditions for this hold. Collective."""
    if reasons := _against_form(problem) + _against_contacts(problem):
        return StrictBound(tuple(reasons))
    return _Bound(problem).result()


def _against_form(problem: MeshErrorProblem) -> list[str]:
    """Return what is against a bound in the cells and forms. Collective."""
    faces, forms = problem.faces, problem.torn.torn.forms
    a, L = forms.bilinear, forms.linear.form
    kinds = {integral.integral_type() for integral in a.form.integrals()}
    degrees = [_compat.element_facts(w.function_space)[1] for w in a.form.coefficients()]
    checks = {
        "strains are finite": problem.is_linearised,
        "the degree is not 1": faces.degree != 1,
        "cells are no triangles or tetrahedra": not faces.kind.is_simplex,
        "cells are curved": faces.geometry_degree != 1,
        "the bilinear form has integrals over facets": kinds != {"cell"},
        "the bilinear form may vary inside cells": any(degrees) or not a.translation_invariant,
        "the linear form has stresses": has_stress(L),
    }
    return [reason for reason, is_against in checks.items() if is_against]


def _against_contacts(problem: MeshErrorProblem) -> list[str]:
    """Return what is against a bound in the laws of contacts, by name."""
    checks = {
        "gaps are those of deformed surfaces": problem.is_exact,
        "there are rigid bodies": bool(problem.solved.body_results),
    }
    reasons = [reason for reason, is_against in checks.items() if is_against]
    for entry in problem.solved.contact_set.entries:
        user = entry.contact if isinstance(entry, FoundContact) else entry.tie
        checks = {
            "has friction": getattr(user, "friction", None) is not None,
            "has a law": getattr(user, "law", None) is not None,
            "has an initial gap": getattr(user, "initial_gap", "geometric") not in _OF_MESH,
            "is no contact or tie of surfaces": not isinstance(
                user, ContactPair | RigidObstacle | TiedPair
            ),
        }
        name = entry.conditions.name
        reasons += [f"{name!r} {reason}" for reason, is_against in checks.items() if is_against]
    return list(dict.fromkeys(reasons))


class _Bound:
    """The bound of a problem, none of whose data are against it so far."""

    def __init__(self, problem: MeshErrorProblem) -> None:
        self._problem, self._faces = problem, problem.faces
        self._comm, self._dim = problem.nodes.comm, problem.faces.dim
        size = problem.faces.size
        self._squares, self._energies = np.zeros((size, 2)), np.zeros(size)
        self._shift = 0.0  # the square of the norm of what makes displacements admissible [J]
        self._against = set[str]()
        self._against_ways = [set[str](), set[str]()]
        u = problem.solved.displacement
        self._u = np.array(u.x.array).reshape(-1, self._dim)
        self._moved = np.zeros_like(self._u)
        self._largest = self._largest_of(self._u)
        # forces that are none [N]
        self._smallest = _ROUNDING * self._largest_of(problem.tractions.moments)

    def result(self) -> StrictBound:
        """Return the bound, or the reasons why there is none. Collective."""
        entries = self._problem.solved.contact_set.entries
        self._volumes = self._faces.volumes()
        for entry in entries:
            if isinstance(entry, FoundContact) and isinstance(entry.contact, RigidObstacle):
                self._lift_off(entry)
        for entry in entries:
            if isinstance(entry, FoundContact) and isinstance(entry.contact, RigidObstacle):
                self._press(entry)
            else:
                self._join(entry)
        self._problem.energies(use=self._add)
        reasons = sorted(self._gathered(self._against))
        of_ways = [sorted(self._gathered(way)) for way in self._against_ways]
        totals = self._comm.allreduce(self._squares.sum(axis=0))
        ways = [way for way in (0, 1) if not of_ways[way]]
        if reasons or not ways:
            return StrictBound(tuple(reasons or of_ways[0]))
        best = min(ways, key=lambda way: float(totals[way]))
        shift = float(np.sqrt(self._comm.allreduce(self._shift)))
        return StrictBound((), self._squares[:, best], self._energies, shift)

    def _gathered(self, reasons: set[str]) -> set[str]:
        return set[str]().union(*self._comm.allgather(reasons))

    def _largest_of(self, values: Vector) -> float:
        return float(self._comm.allreduce(np.abs(values).max(initial=0.0), MPI.MAX))

    # -- contacts ------------------------------------------------------------------------------

    def _facets(self, entry: FoundContact | FoundTie) -> tuple[Numbers, Numbers]:
        """Return the facets on the surfaces of a pair, or on that at an obstacle."""
        mask = self._problem.surfaces[entry.number]
        if isinstance(entry, FoundContact) and isinstance(entry.contact, RigidObstacle):
            tags = surface_tags(entry.contact)[:1]
            mask = tagged(self._faces, entry.contact.facet_tags, tags)
        k, f = np.nonzero(mask)
        return k, f

    def _of_facets(self, facets: tuple[Numbers, Numbers]) -> tuple[Vector, Vector, Vector]:
        """Return outward normals (k, d), moments (k, t, d, 2) [N], and tractions at nodes [Pa].

        Normals have the length of the facet's area.
        """
        k, f = facets
        of_cells = self._problem.tractions.of(k)
        moments = of_cells[np.arange(k.size), f]
        if moments.shape[-1] == 1:
            moments = np.repeat(moments, 2, axis=-1)
        moments = np.where(np.abs(moments) > self._smallest, moments, 0.0)
        normals = self._faces.weighted_normals(k)[np.arange(k.size), f].sum(axis=1)
        inverse = np.linalg.inv(_mass(self._dim - 1))
        areas = np.linalg.norm(normals, axis=1)
        return (
            normals,
            moments,
            np.einsum("ij,kjdv->kidv", inverse, moments) / areas[:, None, None, None],
        )

    def _distances(
        self, entry: FoundContact, facets: tuple[Numbers, Numbers]
    ) -> tuple[Vector, Vector]:
        """Return distances (k, q) of points of facets to an obstacle, and its normals."""
        k, f = facets
        weighted = self._faces.weighted_normals(k)[np.arange(k.size), f]
        normals = weighted / np.linalg.norm(weighted, axis=2, keepdims=True)
        gap, outward = distances_to_obstacle(
            self._faces, entry, self._problem.solved, facets, normals, False
        )
        moved = self._moved[self._faces.nodes_at((k, f))]
        at_points = np.einsum("kqt,ktd->kqd", self._faces.rule.traces[f], moved)
        return gap + np.sum(outward * at_points, axis=2), outward

    def _lift_off(self, entry: FoundContact) -> None:
        """Move nodes off an obstacle so far that facets do not penetrate it. Collective."""
        facets, nodes = self._facets(entry), self._problem.nodes
        gap, outward = self._distances(entry, facets)
        depth = np.maximum(-gap, 0.0).max(axis=1, initial=0.0)
        if self._largest_of(depth) <= _PENETRATION * self._largest:
            return
        largest = np.zeros((nodes.size, 1 + self._dim))
        k, f = facets
        for t in range(self._faces.closure.shape[1]):
            at = self._faces.nodes_at((k, f))[:, t]
            np.maximum.at(largest[:, 0], at, depth)
            largest[at, 1:] = outward[:, 0]
        depths = over_ranks(nodes, largest[:, 0], np.maximum)
        signs = [
            over_ranks(nodes, np.maximum(s * largest[:, 1:], 0.0), np.maximum) for s in (1, -1)
        ]
        normals = signs[0] - signs[1]
        move = depths[:, None] * normals
        if (np.abs(move)[self._problem.kinds.fixed] > _PENETRATION * self._largest).any():
            self._against.add(f"{entry.conditions.name!r} has supported nodes that penetrate")
        self._moved += move

    def _press(self, entry: FoundContact) -> None:
        """Add the work of the pressures on an obstacle over its gaps. Collective."""
        name, facets = repr(entry.conditions.name), self._facets(entry)
        gap, outward = self._distances(entry, facets)
        k, f = facets
        normals, _, tractions = self._of_facets(facets)
        size = self._largest_of(tractions) or 1.0
        turned = np.abs(outward - outward[:, :1]).max(axis=(1, 2), initial=0.0)
        loaded = np.abs(tractions).max(axis=(1, 2, 3), initial=0.0) > _ROUNDING * size
        if (turned[loaded] > _ROUNDING).any():
            self._against.add(f"{name} has an obstacle whose normal turns inside facets")
        self._check_pressures(name, tractions, outward[:, 0], size)
        p = np.einsum("ktdv,kd->ktv", tractions, outward[:, 0])
        at_points = np.einsum("kqt,ktv->kqv", self._faces.rule.traces[f], p)
        weights = self._faces.rule.weights / self._faces.rule.weights.sum()
        areas = np.linalg.norm(normals, axis=1)
        gap = np.where(np.isfinite(gap), np.maximum(gap, 0.0), 0.0)
        work = 2.0 * np.einsum("kqv,kq,q,k->kv", at_points, gap, weights, areas)
        np.add.at(self._squares, k, work)

    def _check_pressures(
        self, name: str, tractions: Vector, direction: Vector, size: float
    ) -> None:
        """Check that tractions (k, t, d, 2) push along directions (k, d), way by way."""
        p = np.einsum("ktdv,kd->ktv", tractions, direction)
        aside = tractions - p[:, :, None] * direction[:, None, :, None]
        for way, reasons in enumerate(self._against_ways):
            if (np.abs(aside[..., way]) > _ROUNDING * size).any():
                reasons.add(f"{name} has forces that are not along the normals of facets")
            elif (p[..., way] < -_ROUNDING * size).any():
                reasons.add(f"{name} has negative pressures between nodes")

    def _join(self, entry: FoundContact | FoundTie) -> None:
        """Add the work of the pressures between two surfaces over their gaps. Collective."""
        name, facets = repr(entry.conditions.name), self._facets(entry)
        k, f = facets
        normals, moments, tractions = self._of_facets(facets)
        nodes = self._faces.nodes_at((k, f))
        x = self._faces.node_points(1, k)[np.arange(k.size)[:, None], self._faces.closure[f]]
        u = self._u[nodes] + self._moved[nodes]
        others = _coincident(self._comm, x, (moments, u))
        size = self._largest_of(moments) or 1.0
        loaded = np.abs(moments).max(axis=(1, 2), initial=0.0) > _ROUNDING * size
        found = others.is_found
        sums = np.abs(moments[found] + others.values[0][found]).max(axis=(1, 2), initial=0.0)
        for way, reasons in enumerate(self._against_ways):
            if (loaded[:, way] & ~found).any():
                reasons.add(f"{name} has facets that do not coincide")
            elif (sums[:, way] > _ROUNDING * size).any():
                reasons.add(f"{name} has forces that differ between both sides")
        jump = (others.values[1] - u) * found[:, None, None]
        if isinstance(entry, FoundTie):
            if (np.abs(jump) > _PENETRATION * self._largest).any():
                self._against.add(f"{name} has displacements that are not equal on both sides")
            return
        n = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        pressures = self._largest_of(tractions) or 1.0
        self._check_pressures(name, tractions[found], -n[found], pressures)
        opening = np.einsum("ktd,kd->kt", jump, n)
        if (opening < -_PENETRATION * self._largest).any():
            self._against.add(f"{name} has displacements that penetrate")
        # half of the work is on each side
        work = -np.einsum("ktdv,kd,kt->kv", moments, n, np.maximum(opening, 0.0))
        np.add.at(self._squares, k, work)

    # -- cells ---------------------------------------------------------------------------------

    def _add(self, rows: Numbers, moments: Vector) -> None:
        """Add the squares of some cells with moments (g, f, t, d, v) of their tractions."""
        d, volume, x = self._dim, self._volumes[rows], self._faces.node_points(1, rows)
        F = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)
        det = np.abs(np.linalg.det(F))
        B, C = self._material(rows, x, F)
        stress = C @ (B @ self._displacements(rows, B, C))
        loads = moments + self._facet_loads(rows)[..., None]
        force = self._volume_force(rows) * det[:, None]
        compliance = np.linalg.inv(C)
        for way in (0, 1):
            tau = self._composite(F, loads[..., min(way, loads.shape[-1] - 1)], force)
            difference = np.einsum("sij,gkaij->gkas", strains(d), tau) - stress[:, None, None, :, 0]
            # over linear functions the mass matrix is that of these and of their sum
            total = difference.sum(axis=2, keepdims=True)
            both = np.concatenate([difference, total], axis=2)
            squares = np.einsum("gkas,gst,gkat->g", both, compliance, both)
            self._squares[rows, way] += squares * volume / ((d + 1) ** 2 * (d + 2))

    def _material(self, rows: Numbers, x: Vector, F: Vector) -> tuple[Vector, Vector]:
        """Return the strains (g, s, n * d) of unit displacements, and the elasticities (g, s, s).

        The stiffness matrices have to follow from these.
        """
        S, volume = strains(self._dim), self._volumes[rows]
        gradients = _gradients(self._dim) @ np.linalg.inv(F)  # (g, d + 1, d)
        B = np.einsum("sij,gnj->gsni", S, gradients).reshape(rows.size, len(S), -1)
        A = self._problem.torn.torn.forms.cell_matrices(self._faces.cells[rows])
        arm = x - x.mean(axis=1, keepdims=True)
        U = np.einsum("sij,gnj->gnis", S, arm).reshape(rows.size, -1, len(S))
        C = U.transpose(0, 2, 1) @ A @ U / volume[:, None, None]
        of_strains = B.transpose(0, 2, 1) @ C @ B * volume[:, None, None]
        if (np.abs(A - of_strains) > _ROUNDING * np.abs(A).max(axis=(1, 2))[:, None, None]).any():
            self._against.add("the bilinear form is not that of strains alone")
        return B, C

    def _displacements(self, rows: Numbers, B: Vector, C: Vector) -> Vector:
        """Return admissible displacements (g, n * d, 1) of some cells, and keep their energies."""
        nodes = self._faces.nodes[rows]
        moved = self._moved[nodes].reshape(rows.size, -1, 1)
        v = self._u[nodes].reshape(rows.size, -1, 1) + moved
        of_both = []
        for u in (v, moved):
            strain = B @ u
            density = (strain.transpose(0, 2, 1) @ C @ strain)[:, 0, 0]
            of_both.append(density * self._volumes[rows])
        self._energies[rows] = of_both[0]
        self._shift += float(of_both[1].sum())
        return v

    def _composite(self, F: Vector, moments: Vector, force: Vector) -> Vector:
        """Return the stresses (g, parts, nodes, d, d) for moments and the force of a cell."""
        d, g = self._dim, len(F)
        inverse = np.linalg.inv(F)
        reference = (moments @ inverse.transpose(0, 2, 1)[:, None]).reshape(g, -1)
        data = np.concatenate([reference, np.einsum("gij,gj->gi", inverse, force)], axis=1)
        solution, conditions, right = composite_stress(d)
        tau = data @ solution.T
        out_of_balance = np.abs(tau @ conditions.T - data @ right.T).max(initial=0.0)
        if out_of_balance > _ROUNDING * np.abs(data).max(initial=0.0):
            self._against.add("forces of cells are out of balance")
        tau = np.einsum("gps,sij->gpij", tau.reshape(g, -1, len(strains(d))), strains(d))
        det = np.abs(np.linalg.det(F))[:, None, None, None]
        mapped = F[:, None] @ tau @ F.transpose(0, 2, 1)[:, None] / det
        return np.asarray(mapped.reshape(g, d + 1, d + 1, d, d))

    def _volume_force(self, rows: Numbers) -> Vector:
        """Return the force (g, d) on the volume of cells, which has to be constant there."""
        volume = self._volumes[rows]
        load = self._problem.neumann.part_of_load(rows, "cell").reshape(rows.size, -1, self._dim)
        force = load.sum(axis=1) / volume[:, None]
        points, weights = quadrature(self._faces.kind.name, 2)
        mean = weights @ shape_values(self._faces.kind.name, 2, points) / weights.sum()
        expected = mean[:, None] * (volume[:, None] * force)[:, None]
        if (np.abs(load - expected) > _ROUNDING * np.abs(load).max(initial=0.0)).any():
            self._against.add("forces on the volume vary inside cells")
        return force

    def _facet_loads(self, rows: Numbers) -> Vector:
        """Return the moments (g, f, t, d) of the loads on facets, which have to be linear."""
        neumann, (f, t), d = self._problem.neumann, self._faces.closure.shape, self._dim
        of_facets = np.zeros((rows.size, f, t, d))
        for facet in range(f):
            load = neumann.part_of_load(rows, "exterior_facet", facet)
            nodal = neumann.restricted(load).reshape(rows.size, -1, d)
            of_facets[:, facet] = nodal[:, self._faces.closure[facet]]
            only = np.zeros((rows.size, f, t, d))
            only[:, facet] = of_facets[:, facet]
            linear = only.reshape(rows.size, -1) @ neumann.lift.T
            if (np.abs(load - linear) > _ROUNDING * np.abs(load).max(initial=0.0)).any():
                self._against.add("loads are not linear on facets")
        return of_facets


@dataclass(frozen=True)
class _Others:
    """Facets (k,) of the other side: which are found, and values at the nodes of this side."""

    is_found: Numbers
    values: list[Vector]


def _coincident(comm: MPI.Intracomm, x: Vector, values: tuple[Vector, ...]) -> _Others:
    """Find for each facet with nodes x (k, t, d) another one at its place. Collective."""
    everywhere = np.concatenate(comm.allgather(x))
    of_all = [np.concatenate(comm.allgather(value)) for value in values]
    if not len(everywhere):
        return _Others(np.zeros(0, dtype=bool), list(values))
    first = comm.exscan(len(x)) or 0
    middles = everywhere.mean(axis=1)
    scale = np.ptp(everywhere.reshape(-1, x.shape[2]), axis=0).max()
    distance, near = cKDTree(middles).query(x.mean(axis=1), 2, distance_upper_bound=scale)
    is_own = near == (first + np.arange(len(x)))[:, None]
    rows, column = np.arange(len(x)), np.where(is_own[:, 0], 1, 0)
    is_found = distance[rows, column] <= _SAME_PLACE * scale
    partner = np.where(is_found, near[rows, column], 0)
    apart = np.linalg.norm(x[:, :, None] - everywhere[partner][:, None], axis=3)
    order = apart.argmin(axis=2)
    is_found &= apart.min(axis=2).max(axis=1, initial=0.0) <= _SAME_PLACE * scale
    return _Others(is_found, [value[partner[:, None], order] for value in of_all])


def _mass(dim: int) -> Vector:
    """Return the integrals of products of linear functions over a simplex with unit volume."""
    return (np.ones((dim + 1, dim + 1)) + np.eye(dim + 1)) / ((dim + 1) * (dim + 2))


def _gradients(dim: int) -> Vector:
    """Return the gradients (dim + 1, dim) of the linear functions of a reference simplex."""
    return np.vstack([-np.ones((1, dim)), np.eye(dim)])


@cache
def strains(dim: int) -> Vector:
    """Return an orthonormal basis (s, dim, dim) of symmetric matrices."""
    basis = []
    for i, j in [(i, i) for i in range(dim)] + list(combinations(range(dim), 2)):
        E = np.zeros((dim, dim))
        E[i, j] = E[j, i] = 1.0 if i == j else np.sqrt(0.5)
        basis.append(E)
    return np.array(basis)


@cache
def composite_stress(dim: int) -> tuple[Vector, Vector, Vector]:
    """Return the composite stress of a reference simplex for moments and a constant force.

    The solution maps these (facets * dim * dim + dim) to components (parts * nodes * s) in the
    basis `strains`. Part f has the vertices of facet f, in their order, and the centroid. The
    stress has to fulfil conditions (c, .), with right-hand sides that follow from the data: it does
    where these are in balance.
    """
    shape = _Composite(dim)
    for part in range(dim + 1):
        shape.add_moments(part)
        shape.add_balance(part)
    for p, q in combinations(range(dim + 1), 2):
        shape.add_continuity(p, q)
    conditions, right = np.array(shape.rows), np.array(shape.right)
    return np.linalg.pinv(conditions, rcond=1e-10) @ right, conditions, right


class _Composite:
    """The conditions for the components of a composite stress, and their right-hand sides."""

    def __init__(self, dim: int) -> None:
        name = {2: "triangle", 3: "tetrahedron"}[dim]
        self.dim, self.facets, self.S = dim, reference_cell(name).facets, strains(dim)
        self.vertices = np.vstack([np.zeros((1, dim)), np.eye(dim)])
        self.centroid = self.vertices.mean(axis=0)
        self.rows: list[Vector] = []
        self.right: list[Vector] = []

    def _add(self, factors: dict[tuple[int, int], Vector], data: dict[int, float]) -> None:
        """Add conditions: sums of stresses at nodes (part, node) times vectors equal some data."""
        s, nodes, d = len(self.S), self.dim + 1, self.dim
        row, right = np.zeros((d, nodes * nodes * s)), np.zeros((d, nodes * d * d + d))
        for (part, node), vector in factors.items():
            first = (part * nodes + node) * s
            row[:, first : first + s] = (self.S @ vector).T
        for number, value in data.items():
            right[:, number * d : number * d + d] = value * np.eye(d)
        self.rows += list(row)
        self.right += list(right)

    def add_moments(self, part: int) -> None:
        """Let the traction on a facet have given moments."""
        corners, d = list(self.facets[part]), self.dim
        (opposite,) = set(range(d + 1)) - set(corners)
        normal = _area_normal(self.vertices[corners], self.vertices[opposite])
        for i, masses in enumerate(_mass(d - 1)):
            self._add(
                {(part, j): mass * normal for j, mass in enumerate(masses)}, {part * d + i: 1}
            )

    def add_balance(self, part: int) -> None:
        """Let the divergence balance the force."""
        points = np.vstack([self.vertices[list(self.facets[part])], self.centroid])
        gradients = _gradients(self.dim) @ np.linalg.inv((points[1:] - points[0]).T)
        force = (self.dim + 1) * self.dim
        self._add({(part, node): g for node, g in enumerate(gradients)}, {force: -1})

    def add_continuity(self, p: int, q: int) -> None:
        """Let tractions between two parts be continuous."""
        first, second = (list(self.facets[part]) for part in (p, q))
        common = sorted(set(first) & set(second))
        (other,) = set(first) - set(common)
        points = np.vstack([self.vertices[common], self.centroid])
        normal = _area_normal(points, self.vertices[other])
        places = [(first.index(v), second.index(v)) for v in common] + [(self.dim, self.dim)]
        for a, b in places:
            self._add({(p, a): normal, (q, b): -normal}, {})


def _area_normal(points: Vector, inner: Vector) -> Vector:
    """Return the normal of a facet, as long as its area, that points away from an inner point."""
    edges = points[1:] - points[0]
    if len(points) == 2:
        normal = np.array([edges[0, 1], -edges[0, 0]])
    else:
        normal = np.cross(edges[0], edges[1]) / 2.0
    return np.asarray(-np.sign(normal @ (inner - points[0])) * normal)
