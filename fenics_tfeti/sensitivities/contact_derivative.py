"""The derivative of equilibrium and contact at a state whose rows follow the displacement.

With the normal, tangential and tied forces p of the rows that hold, their distances g, and the
forces G(u, p) of rows along the present normals, friction at its bounds among them, it is

    A (d, p) = (K d + H d + dG/dp p,  C d),    H = dG/du,  C = -dg/du.

H and C are sparse matrices over the nodes of surfaces, so that tangents by A and adjoints by A' are
transposed to rounding. Both are by GMRES with the linear problem of the last set-up, which is
symmetric, as the preconditioner.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError, NotConverged
from fenics_tfeti.fem.displacement import fill_owned, owned_values, prescribed_components
from fenics_tfeti.fem.torn_problem import TornProblem
from fenics_tfeti.feti import Subdomain
from fenics_tfeti.feti.system import ContactRows, RowValues
from fenics_tfeti.newton.equilibrium import DeformedRows, Multipliers
from fenics_tfeti.parallel import positions, raise_collectively
from fenics_tfeti.qp import Space
from fenics_tfeti.qp.gmres import gmres
from fenics_tfeti.sensitivities.adjoint import Functional
from fenics_tfeti.sensitivities.row_supports import RowDerivatives, RowSupports
from fenics_tfeti.typing import Mask, Numbers, Vector

# of differences of rows, relative to the shortest edge at a node
_STEP = 3e-5
# linear solves at the most
_MOST = 100

# the linear problem of the last set-up: loads (owned, gdim) and jumps -> displacements (n,),
# forces, and products with F
Solve = Callable[[Vector, RowValues], tuple[Vector, RowValues, int]]
# a displacement (n,) from the state -> rows there
RowsAt = Callable[[Vector], DeformedRows]


@dataclass(frozen=True)
class HeldRows:
    """The rows of a state with their forces."""

    rows: DeformedRows
    multipliers: Multipliers

    @cached_property
    def held(self) -> Mask:
        """Which contact rows press, (k,)."""
        return self.multipliers.normal[self.rows.place] > 0.0

    @cached_property
    def slips(self) -> Mask:
        """Which sites are at their bound of friction, (sites,)."""
        return self._acts & self.multipliers.slipping[self._place]

    @cached_property
    def sticks(self) -> Mask:
        """Which sites friction holds, (sites,)."""
        return self._acts & ~self.multipliers.slipping[self._place]

    @cached_property
    def counts(self) -> Mask:
        """Which rows of contacts and ties have forces, (k + tied rows,)."""
        counts = self.held.copy()
        counts[self.rows.friction.row[self._acts]] = True
        return np.append(counts, np.ones(self.rows.tied.size, dtype=bool))

    @cached_property
    def along(self) -> Vector:
        """Unit vectors along friction at its bound (sites, gdim - 1), zero at other sites."""
        forces = self.rows.friction_forces(self.multipliers_in(self.rows))
        size = np.linalg.norm(forces, axis=1, keepdims=True)
        along = np.divide(forces, size, out=np.zeros_like(forces), where=size > 0.0)
        return np.where(self.slips[:, None], along, 0.0)

    @property
    def _place(self) -> Numbers:
        return self.rows.place[self.rows.friction.row]

    @cached_property
    def _acts(self) -> Mask:
        return self.rows.slip_bounds(self.multipliers) > 0.0

    def multipliers_in(self, rows: DeformedRows) -> Multipliers:
        """Return the multipliers in other rows: friction at its bound turns with the slip.

        To first order in the change of the slip, which may be small.
        """
        multipliers, friction = rows.at_bounds(self.multipliers), rows.friction
        if friction.tangents.shape[1] == 1 or not self.slips.any():
            return multipliers
        place, slip = rows.place[friction.row], self._slip
        size = np.linalg.norm(slip, axis=1, keepdims=True)[place]
        turns = multipliers.slipping[place] & (size[:, 0] > 0.0)
        place, size = place[turns], size[turns]
        along, change = slip[place] / size, (_vectors(rows, rows.slip)[turns] - slip[place]) / size
        along += change - np.sum(along * change, axis=1, keepdims=True) * along
        bound = rows.slip_bounds(multipliers) / rows.contacts.length[friction.row]
        tangential = multipliers.tangential.copy()
        tangential[place] = bound[turns, None] * along
        return replace(multipliers, tangential=tangential)

    @cached_property
    def _slip(self) -> Vector:
        """The slips of the state at the surfaces' nodes (s, gdim) [m]."""
        slip = np.zeros_like(self.multipliers.tangential)
        slip[self._place] = _vectors(self.rows, self.rows.slip)
        return slip

    def numbers_in(self, rows: DeformedRows, nodes: Numbers, unit: float) -> sp.csr_matrix:
        """Return forces and distances of the rows that count, as they are in other rows [N].

        The columns are forces (n * gdim) at ascending nodes; then the distance, and the vector from
        which slip is counted, times a unit [N/m]; then the normal force, and the force that normal
        and tangents have.
        """
        count, gdim = self.held.size, self.rows.contact_set.boundary.nodes.components
        of_place = np.full(self.multipliers.normal.size, -1)
        of_place[self.rows.place] = np.where(self.counts[:count], np.arange(count), -1)
        row = of_place[rows.place]
        if np.setdiff1d(np.flatnonzero(self.counts[:count]), row).size:
            raise InputError(
                "nodes that press are opposite nothing after a small displacement: where edges of "
                "surfaces lie on each other the solution has no derivatives"
            )
        row = np.append(row, count + np.arange(rows.tied.size))
        multipliers = self.multipliers_in(rows)
        of_row, at, forces = rows.force_terms(multipliers)
        column = gdim * positions(nodes, at)[:, None] + np.arange(gdim)
        parts = [(np.repeat(row[of_row], gdim), column.ravel(), forces.ravel())]
        dense = _dense(rows, multipliers, unit)
        columns = gdim * nodes.size + np.arange(dense.shape[1])
        parts.append((np.repeat(row, columns.size), np.tile(columns, row.size), dense.ravel()))
        at_row, at_column, values = (np.concatenate(part) for part in zip(*parts, strict=True))
        known = (at_row >= 0) & (values != 0.0)
        shape = count + rows.tied.size, gdim * nodes.size + dense.shape[1]
        return sp.csr_matrix((values[known], (at_row[known], at_column[known])), shape)


def _vectors(rows: DeformedRows, values: Vector) -> Vector:
    """Return the vectors (sites, gdim) of values along tangents."""
    return np.einsum("kt,kta->ka", values, rows.friction.tangents)


def _dense(rows: DeformedRows, multipliers: Multipliers, unit: float) -> Vector:
    """Return distances, slips, normal forces and forces (k + tied rows, 2 * gdim + 2)."""
    normal, site = rows.normal_forces(multipliers), rows.friction.row
    gdim, contacts, tied = rows.contacts.coefficients.shape[1], rows.contacts, rows.tied
    of_contacts, of_ties = np.zeros((contacts.size, 2 * gdim + 2)), np.zeros((tied.size, 1))
    distance = np.append(rows.distance, tied.gap / tied.length)
    distance = unit * np.where(np.isfinite(distance), distance, 0.0)
    of_contacts[:, 0], of_ties[:, 0] = np.split(distance, [contacts.size])
    of_contacts[site, 1 : gdim + 1] = unit * _vectors(rows, np.asarray(rows.friction.slip))
    of_contacts[:, gdim + 1] = normal
    of_contacts[:, gdim + 2 :] = normal[:, None] * contacts.normal
    of_contacts[site, gdim + 2 :] += _vectors(rows, rows.friction_forces(multipliers))
    return np.concatenate([of_contacts, np.pad(of_ties, ((0, 0), (0, 2 * gdim + 1)))])


@dataclass(frozen=True)
class SurfaceMatrices:
    """Sparse matrices over the s degrees of freedom of the surfaces' nodes, of this rank's rows.

    The r rows are those of `RowValues` one after the other: contacts, sites by tangent, ties.
    """

    supports: RowSupports
    hessian: sp.csr_matrix  # (s, s): H
    numbers: sp.csr_matrix  # (q * (k + tied rows), s): of the q numbers of `_dense`
    closing: sp.csr_matrix  # (r, s): C
    pressing: sp.csr_matrix  # (r, s): dG/dp transposed
    slips: sp.csr_matrix  # (sites * directions, s): rows along the tangents

    @staticmethod
    def of(state: HeldRows, rows_at: RowsAt, unit: float) -> SurfaceMatrices:
        """Return them by differences of rows along displacements (n,) of nodes. Collective."""
        contact_set = state.rows.contact_set
        gdim = contact_set.boundary.nodes.components
        supports = RowSupports.of(contact_set, contact_set.boundary.space, state.counts)

        def numbers_at(change: Function) -> sp.csr_matrix:
            rows = rows_at(owned_values(change))
            with raise_collectively(supports.nodes.comm):
                return state.numbers_in(rows, supports.numbers, unit)

        found = RowDerivatives.of(supports, numbers_at, _STEP, "rows of contacts")
        s, q = gdim * supports.numbers.size, 2 * gdim + 2
        is_force = found.column < s
        at = np.where(is_force, found.column, q * found.row + found.column - s)
        hessian, numbers = (
            sp.coo_matrix((found.value[part], (at[part], found.unknown[part])), shape).tocsr()
            for part, shape in ((is_force, (s, s)), (~is_force, (q * state.counts.size, s)))
        )
        closing = _of_distances(state, unit) @ numbers
        rows = state.rows
        slips = _matrix(rows.friction.tangential_rows(rows.contacts), supports)
        pressing = _pressing(state, supports, slips)
        return SurfaceMatrices(supports, hessian, numbers, closing, pressing, slips)


def _of_distances(state: HeldRows, unit: float) -> sp.csr_matrix:
    """Return the matrix (r, q * (k + tied rows)) of -g by the numbers of `_dense`."""
    tangents, site = state.rows.friction.tangents, state.rows.friction.row
    (sites, directions, gdim), k, tied = tangents.shape, state.held.size, state.rows.tied.size
    q, rows = 2 * gdim + 2, np.flatnonzero(state.held)
    ties, slips = np.arange(tied), np.arange(sites * directions).reshape(sites, directions, 1)
    columns = (q * site)[:, None, None] + 1 + np.arange(gdim)
    of_slips = np.where(state.sticks[:, None, None], tangents, 0.0)
    parts = [
        (rows, q * rows, np.ones(rows.size)),
        (np.broadcast_to(k + slips, tangents.shape), columns, of_slips),
        (k + slips.size + ties, q * (k + ties), np.ones(tied)),
    ]
    at_row, at_column, values = (
        np.concatenate([np.broadcast_to(x, v.shape).ravel() for x, v in pairs])
        for pairs in (
            [(row, v) for row, _, v in parts],
            [(column, v) for _, column, v in parts],
            [(v, v) for _, _, v in parts],
        )
    )
    shape = k + slips.size + tied, q * (k + tied)
    return sp.csr_matrix((-values / unit, (at_row, at_column)), shape)


def _pressing(state: HeldRows, supports: RowSupports, tangential: sp.csr_matrix) -> sp.csr_matrix:
    """Return the nodal forces (r, s) of unit forces of the rows that hold.

    Friction at its bound follows the normal force.
    """
    rows, friction, k = state.rows, state.rows.friction, state.held.size
    normal, tied = (_matrix(part, supports) for part in (rows.contacts, rows.tied))
    sites, directions = friction.tangents.shape[:2]
    follows = np.asarray(friction.coefficient)[:, None] * state.along
    shape = k, sites * directions
    of_slips = sp.csr_matrix(
        (follows.ravel(), (np.repeat(friction.row, directions), np.arange(shape[1]))), shape
    )
    held, sticks = (
        sp.diags(x.astype(float)) for x in (state.held, state.sticks.repeat(directions))
    )
    return sp.vstack([held @ (normal + of_slips @ tangential), sticks @ tangential, tied]).tocsr()


def _matrix(rows: ContactRows, supports: RowSupports) -> sp.csr_matrix:
    """Return rows of unit length over the degrees of freedom of the surfaces' nodes."""
    gdim = rows.coefficients.shape[1]
    columns = gdim * positions(supports.numbers, rows.nodes)[:, None] + np.arange(gdim)
    values = rows.coefficients / rows.length[rows.row][:, None]
    shape = rows.size, gdim * supports.numbers.size
    return sp.csr_matrix((values.ravel(), (np.repeat(rows.row, gdim), columns.ravel())), shape)


@dataclass(frozen=True)
class ContactDerivative:
    """The derivative at a state, and its transposed form.

    Vectors are nodal displacements (n,) at the degrees of freedom that this rank owns, and forces
    at rows; right-hand sides are nodal forces and jumps.
    """

    torn: TornProblem
    subdomains: Sequence[Subdomain]  # with exact tangents
    state: HeldRows
    surfaces: SurfaceMatrices
    solve: Solve
    unit: float  # a stiffness: jumps count as forces [N/m]

    def times(self, x: Vector, transposed: bool = False) -> Vector:
        """Return A x or A' x. Collective."""
        surfaces, (d, p) = self.surfaces, self.split(x)
        hessian, by_forces, to_jumps = surfaces.hessian, surfaces.pressing, surfaces.closing
        if transposed:
            hessian, by_forces, to_jumps = hessian.T, surfaces.closing, surfaces.pressing
        at_surfaces = self.on_surfaces(d)
        force = self._stiffness_times(d, transposed)
        force += self.from_surfaces(hessian @ at_surfaces + by_forces.T @ p)
        return np.concatenate([force, to_jumps @ at_surfaces])

    def split(self, x: Vector) -> tuple[Vector, Vector]:
        """Return the parts of nodes and of rows."""
        size = self.torn.nodes.owned * self.torn.nodes.components
        return x[:size], x[size:]

    @property
    def rows(self) -> int:
        """The number of values of rows."""
        return int(self.surfaces.closing.shape[0])

    def normal_forces_by(self, d: Vector) -> Vector:
        """Return the changes (k,) of normal forces of constant multipliers [N]. Collective.

        They are those of areas, along a displacement (n,).
        """
        changes = self.surfaces.numbers @ self.on_surfaces(d)
        gdim, k = self.torn.nodes.components, self.state.held.size
        return np.asarray(changes.reshape(-1, 2 * gdim + 2)[:k, gdim + 1])

    def forces_of_bounds(self, change: Vector) -> Vector:
        """Return nodal forces (n,) of friction at its bound, for changes (sites,). Collective."""
        along = self.state.along * change[:, None]
        return self.from_surfaces(self.surfaces.slips.T @ along.ravel())

    def by_bounds(self, z: Vector, J: Functional) -> Vector:
        """Return the derivatives (sites,) of J by slip bounds, with the adjoint z. Collective."""
        rows, along = self.state.rows, self.state.along
        slips = (self.surfaces.slips @ self.on_surfaces(z)).reshape(along.shape)
        by_forces = J.by_forces(rows.contacts.normal, rows.friction).tangential
        return np.asarray(np.sum((by_forces - slips) * along, axis=1))

    def of_rows(self, rows: DeformedRows, x: Vector, J: Functional) -> Vector:
        """Return what J changes by with each of other rows (k + tied rows,). Collective.

        That is -z'G(u, p) + a'g with the adjoint x = (z, a), and what J has of the forces.
        """
        z, a = self.split(x)
        at_surfaces, numbers = self.on_surfaces(z), self.surfaces.supports.numbers
        with raise_collectively(self.torn.nodes.comm):
            found = self.state.numbers_in(rows, numbers, self.unit)
        weights = self._weights(J)
        weights -= (_of_distances(self.state, self.unit).T @ a).reshape(weights.shape)
        forces, dense = found[:, : at_surfaces.size], found[:, at_surfaces.size :].toarray()
        return np.asarray(np.sum(dense * weights, axis=1) - forces @ at_surfaces)

    def _weights(self, J: Functional) -> Vector:
        """Return the weights of the numbers of `_dense` in J, (k + tied rows, 2 * gdim + 2)."""
        gdim, k = self.torn.nodes.components, self.state.held.size
        weights = np.zeros((self.state.counts.size, 2 * gdim + 2))
        weights[:k, gdim + 1], weights[:k, gdim + 2 :] = J.normal, J.force
        return weights

    def functional(self, J: Functional) -> Vector:
        """Return the derivative of a functional by displacements and forces of rows. Collective."""
        state, friction = self.state, self.state.rows.friction
        by_areas = self.from_surfaces(self.surfaces.numbers.T @ self._weights(J).ravel())
        by_forces = J.by_forces(state.rows.contacts.normal, friction)
        normal, tangential = by_forces.normal.copy(), by_forces.tangential
        follows = np.asarray(friction.coefficient)[:, None] * state.along
        np.add.at(normal, friction.row, np.sum(follows * tangential, axis=1))
        by_sticking = np.where(state.sticks[:, None], tangential, 0.0).ravel()
        none = np.zeros(state.rows.tied.size)
        by_rows = [np.where(state.held, normal, 0.0), by_sticking, none]
        return np.concatenate([J.u + by_areas, *by_rows])

    def as_row_values(self, p: Vector) -> RowValues:
        """Return values of rows as those of contacts, sites and ties."""
        sites, directions = self.state.rows.friction.tangents.shape[:2]
        k = self.state.held.size
        normal, tangential, tied = np.split(p, [k, k + sites * directions])
        return RowValues(normal, tangential.reshape(sites, directions), tied)

    def on_surfaces(self, d: Vector) -> Vector:
        """Return nodal values (n,) at the surfaces' degrees of freedom of all ranks. Collective."""
        supports, gdim = self.surfaces.supports, self.torn.nodes.components
        values = np.zeros((supports.numbers.size, gdim))
        values[supports.here] = d.reshape(-1, gdim)[supports.owned]
        total: Vector = self.torn.nodes.comm.allreduce(values.ravel())
        return total

    def from_surfaces(self, values: Vector) -> Vector:
        """Return the sums over ranks of values at the surfaces' degrees of freedom. Collective."""
        supports, gdim = self.surfaces.supports, self.torn.nodes.components
        total = np.zeros((self.torn.nodes.owned, gdim))
        sums = self.torn.nodes.comm.allreduce(values).reshape(-1, gdim)
        total[supports.owned] = sums[supports.here]
        return total.ravel()

    def _stiffness_times(self, d: Vector, transposed: bool) -> Vector:
        torn = self.torn
        values = torn.nodes.values(fill_owned(Function(torn.space), d))
        forces = [
            s.stiffness_times(values[torn.nodes.to_local(s.nodes)].ravel(), transposed)
            for s in self.subdomains
        ]
        return torn.sum_at_nodes(self.subdomains, forces).ravel()

    def solved(self, right: Vector, rtol: float, transposed: bool = False) -> tuple[Vector, int]:
        """Solve A x = b or A' x = b at free displacements; return applications of F, too.

        Collective.

        Raises
        ------
        NotConverged
            GMRES leaves more than the part `rtol` of b.
        """
        free, products, comm = self._free, 0, self.torn.nodes.comm
        scale = np.concatenate([free, np.full(right.size - free.size, self.unit)])

        def step(v: Vector) -> tuple[Vector, Vector]:
            nonlocal products
            force, jumps = self.split(v)
            d, forces, count = self.solve(force, self.as_row_values(jumps / self.unit))
            products += count
            p = [forces.normal, forces.tangential.ravel(), forces.tied]
            x = np.concatenate([free * d, *p])
            return x, scale * self.times(x, transposed)

        space, b = Space(sum_over_ranks=comm.allreduce), scale * right
        norm = space.norm(b)
        vectors, y, left = gmres(step, b, space, tolerance=rtol * norm, max_it=_MOST)
        if left > rtol * norm:
            raise NotConverged(
                f"the linear problem at the last state is not solved to rtol {rtol:g}: GMRES "
                f"leaves {left / norm:.1e} after {len(vectors)} linear solves"
            )
        x = sum((c * v for c, v in zip(y, vectors, strict=True)), np.zeros_like(b))
        return x, products

    @cached_property
    def _free(self) -> Vector:
        """One at free displacements (n,), zero at prescribed ones."""
        nodes, prescribed = self.torn.nodes, self.state.rows.contact_set.prescribed
        fixed = prescribed_components(nodes, prescribed)[: nodes.owned]
        return np.where(fixed, 0.0, 1.0).ravel()
