"""The user's forms assembled on torn subdomains: K_i and f_i (sec. 11.5).

No subdomain has a mesh of its own: the forms are integrated on the user's mesh with a space whose
cells share nodes within a subdomain only. The matrix on it is block diagonal, with K_i as blocks.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

import ufl
from dolfinx.fem import Function, FunctionSpace
from dolfinx.mesh import Mesh
from ufl import geometry
from ufl.corealg.traversal import traverse_unique_terminals

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.partition import cell_facets, exterior_cell_facets
from fenics_tfeti.fem.decomposition.parts import Part, find_equal
from fenics_tfeti.feti import Subdomain
from fenics_tfeti.parallel import raise_collectively

__all__ = ["BoundForms", "FormValues", "prepare_forms", "same_values"]

logger = logging.getLogger(__name__)

Numbers = NDArray[np.int32]

_SUPPORTED = ("cell", "exterior_facet")
_FREE_OF_PLACE = (
    geometry.CellDiameter,
    geometry.CellVolume,
    geometry.Circumradius,
    geometry.FacetArea,
    geometry.FacetNormal,
    geometry.Jacobian,
    geometry.JacobianDeterminant,
    geometry.JacobianInverse,
    geometry.MaxCellEdgeLength,
    geometry.MaxFacetEdgeLength,
    geometry.MinCellEdgeLength,
    geometry.MinFacetEdgeLength,
)
# no tag: cells and facets are only ever tagged with what the form integrates over
_NOWHERE = np.iinfo(np.int64).min


@dataclass(frozen=True)
class _PreparedForm:
    """A form compiled once, with the tags of its integrals for the user's cells.

    Attributes
    ----------
    name : str
        For messages.
    compiled : CompiledForm
        The kernel.
    coefficients : list of Function
        The user's coefficients.
    constants : list of Constant
        The user's constants.
    cell_tag : (cells,) integer array or None
        Tag of each cell, where the form has integrals over cells.
    facet_tag : (cells, facets of a cell) integer array or None
        Tag of each facet of each cell, on the boundary of the bodies only, where the form has
        integrals over facets.
    cell_ids, facet_ids : list of int
        The tags that the form's integrals name.
    at_any_place : bool
        Whether equal cells at different places give equal matrices.
    """

    name: str
    compiled: _compat.CompiledForm
    coefficients: list[Function]
    constants: list[Any]
    cell_tag: NDArray[np.int64] | None
    facet_tag: NDArray[np.int64] | None
    cell_ids: list[int]
    facet_ids: list[int]
    at_any_place: bool


@dataclass(frozen=True)
class FormValues:
    """Copies of the coefficients' and constants' values, to see later whether they changed.

    Attributes
    ----------
    bilinear, linear : list of arrays
        Of a and L.
    """

    bilinear: list[NDArray[np.float64]]
    linear: list[NDArray[np.float64]]


@dataclass(frozen=True)
class BoundForms:
    """The user's forms, ready to be assembled on any of this rank's cells.

    Attributes
    ----------
    space : FunctionSpace
        The user's space.
    bilinear, linear : _PreparedForm
        a and L.
    """

    space: FunctionSpace
    bilinear: _PreparedForm
    linear: _PreparedForm

    def subdomains(
        self, parts: Sequence[Part], known: Sequence[Subdomain] | None = None
    ) -> list[Subdomain]:
        """Assemble K_i and f_i of this rank's subdomains. Collective.

        Parameters
        ----------
        parts : sequence of Part
            Their cells and nodes.
        known : sequence of Subdomain, optional
            The same subdomains at an earlier time: all but f_i is taken from them.

        Returns
        -------
        list of Subdomain
            With the node numbers of the user's space. Those with equal data of `a` (shape,
            coefficients and tags, where `a` does not ask for the place) share K_i.
        """
        loads = self._loads(parts)
        if known is not None:
            return [replace(old, load=load) for old, load in zip(known, loads, strict=True)]
        x = self.space.tabulate_dof_coordinates()[:, : self.space.mesh.geometry.dim]
        to_global = self.space.dofmap.index_map.local_to_global
        return [
            Subdomain(
                K,
                load,
                np.ascontiguousarray(x[part.nodes]),
                np.asarray(to_global(part.nodes), dtype=np.int64),
                part.body,
            )
            for part, K, load in zip(parts, self._stiffnesses(parts, x), loads, strict=True)
        ]

    def values(self) -> FormValues:
        """Return the present values of all that the forms depend on.

        Raises
        ------
        InputError
            NaN in coefficients and constants.
        """
        with raise_collectively(self.space.mesh.comm):
            return FormValues(_values(self.bilinear), _values(self.linear))

    def _stiffnesses(self, parts: Sequence[Part], x: NDArray[np.float64]) -> list[sp.csr_matrix]:
        """Assemble one matrix for all parts with equal data."""
        form = self.bilinear
        data: list[NDArray[Any]] = [
            values for values in (form.cell_tag, form.facet_tag) if values is not None
        ]
        data += [_values_of_cells(w) for w in form.coefficients]
        first = find_equal(parts, x, data, form.at_any_place)
        different = sorted(set(first))
        logger.info(
            "rank %d: %d subdomains have %d different stiffness matrices",
            self.space.mesh.comm.rank,
            len(parts),
            len(different),
        )
        V, ends = self._torn_space([parts[i] for i in different])
        bound = _bind(form, [V, V], [parts[i].cells for i in different])
        indptr, indices, values = _compat.assemble_stiffness(bound)
        blocks = {
            i: _block(indptr, indices, values, begin, end)
            for i, (begin, end) in zip(different, pairwise(ends), strict=True)
        }
        return [blocks[i] for i in first]

    def _loads(self, parts: Sequence[Part]) -> list[NDArray[np.float64]]:
        V, ends = self._torn_space(parts)
        load = _compat.assemble_load(_bind(self.linear, [V], [part.cells for part in parts]))
        return [load[begin:end].copy() for begin, end in pairwise(ends)]

    def _torn_space(self, parts: Sequence[Part]) -> tuple[FunctionSpace, list[int]]:
        """Return a space whose nodes are those of the parts, one by one, and where each begins."""
        ends = np.cumsum([0, *(part.nodes.size for part in parts)])
        # dolfinx looks at all cells: those that are left out have the same node, behind all others
        dofs = np.full(_compat.cell_dofs(self.space).shape, ends[-1], dtype=np.int32)
        for part, begin in zip(parts, ends, strict=False):
            dofs[part.cells] = part.table + begin
        block = self.space.dofmap.index_map_bs
        return _compat.space_with_dofs(self.space, dofs, int(ends[-1]) + 1), list(block * ends)


def prepare_forms(space: FunctionSpace, a: ufl.Form, L: ufl.Form) -> BoundForms:
    """Compile the user's forms once, and look up what their measures' tags mean.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space.
    a, L : ufl.Form
        Bilinear and linear form, with integrals over cells and exterior facets.

    Returns
    -------
    BoundForms
        To assemble subdomains.

    Raises
    ------
    InputError
        Unsupported integrals, coefficients or tag data; NaN in coefficients and constants.
    """
    exterior = exterior_cell_facets(space.mesh)
    return BoundForms(
        space,
        _prepare(space, a, "bilinear form a (the stiffness)", exterior),
        _prepare(space, L, "linear form L (the load)", exterior),
    )


def same_values(
    before: Sequence[NDArray[np.float64]], now: Sequence[NDArray[np.float64]], comm: MPI.Intracomm
) -> bool:
    """Tell, on all ranks alike, whether values are what they were."""
    same = all(np.array_equal(x, y) for x, y in zip(before, now, strict=True))
    return bool(comm.allreduce(same, MPI.LAND))


def _values(form: _PreparedForm) -> list[NDArray[np.float64]]:
    _check_values(form.name, form.coefficients, form.constants)
    coefficients = [np.array(w.x.array, dtype=float) for w in form.coefficients]
    return coefficients + [np.array(c.value, dtype=float) for c in form.constants]


def _prepare(
    space: FunctionSpace, form: ufl.Form, name: str, exterior: NDArray[np.bool_]
) -> _PreparedForm:
    domain = space.mesh
    with raise_collectively(domain.comm):
        _check_integrals(form, name)
        _check_data(form, name, domain)
    data = _compat.subdomain_data(form)
    cell_ids = _tagged_ids(form, "cell")
    facet_ids = _tagged_ids(form, "exterior_facet")
    with raise_collectively(domain.comm):
        for kind, ids in (("cell", cell_ids), ("exterior_facet", facet_ids)):
            _check_tags(data.get(kind), kind, ids, name, domain)

    owned = domain.topology.index_map(domain.topology.dim).size_local
    cell_tag = facet_tag = None
    if _has(form, "cell"):
        of_cell = _dense_tags(data.get("cell"), owned, cell_ids)
        form, cell_ids, cell_tag = _tag_everywhere(form, "cell", cell_ids, of_cell)
    if _has(form, "exterior_facet"):
        facet_of, _ = cell_facets(domain)
        of_facet = _dense_tags(
            data.get("exterior_facet"), int(facet_of.max(initial=-1)) + 1, facet_ids
        )
        form, facet_ids, of_facet = _tag_everywhere(form, "exterior_facet", facet_ids, of_facet)
        facet_tag = np.where(exterior, of_facet[facet_of[:owned]], _NOWHERE)
    return _PreparedForm(
        name,
        _compat.CompiledForm(form, domain.comm),
        list(form.coefficients()),
        list(form.constants()),
        cell_tag,
        facet_tag,
        cell_ids,
        facet_ids,
        _is_free_of_place(form),
    )


def _has(form: ufl.Form, kind: str) -> bool:
    return any(integral.integral_type() == kind for integral in form.integrals())


def _is_free_of_place(form: ufl.Form) -> bool:
    """Tell whether a form takes nothing from the mesh but what a translation leaves as it is."""
    return all(
        isinstance(thing, _FREE_OF_PLACE)
        for integral in form.integrals()
        for thing in traverse_unique_terminals(integral.integrand())
        if isinstance(thing, geometry.GeometricQuantity)
    )


def _check_integrals(form: ufl.Form, name: str) -> None:
    for integral in form.integrals():
        kind = integral.integral_type()
        if kind not in _SUPPORTED:
            raise InputError(
                f"the {name} has an integral over {kind}; subdomains are torn apart, so only "
                "dx and ds can be used"
            )


def _check_data(form: ufl.Form, name: str, domain: Mesh) -> None:
    for number, coefficient in enumerate(form.coefficients()):
        label = _label(number, coefficient, name)
        W = coefficient.function_space
        if _compat.cpp_object(W.mesh) is not _compat.cpp_object(domain):
            raise InputError(f"{label} lives on another mesh than the displacement")
        family, degree, _ = _compat.element_facts(W)
        if "Discontinuous" not in family and not (family == "Lagrange" and degree <= 2):
            raise InputError(
                f"{label} has the element {family} of degree {degree}; coefficients may be "
                "discontinuous Lagrange of any degree, or Lagrange of degree 1 or 2. Interpolate it"
            )
    _check_values(name, form.coefficients(), form.constants())


def _check_values(name: str, coefficients: Sequence[Function], constants: Sequence[Any]) -> None:
    for number, coefficient in enumerate(coefficients):
        bad = np.count_nonzero(~np.isfinite(coefficient.x.array))
        if bad:
            raise InputError(
                f"{_label(number, coefficient, name)} has {bad} values that are NaN or infinite"
            )
    for number, constant in enumerate(constants):
        if not np.isfinite(constant.value).all():
            raise InputError(
                f"constant {number} of the {name} is NaN or infinite: {constant.value}"
            )


def _label(number: int, coefficient: Function, name: str) -> str:
    return f"coefficient {number} ({getattr(coefficient, 'name', 'unnamed')}) of the {name}"


def _tagged_ids(form: ufl.Form, kind: str) -> list[int]:
    """Return the tags that a form's integrals of one kind are limited to."""
    ids: set[int] = set()
    for integral in form.integrals():
        if integral.integral_type() == kind and integral.subdomain_id() not in (
            "everywhere",
            "otherwise",
        ):
            ids.update(np.atleast_1d(integral.subdomain_id()).tolist())
    return sorted(ids)


def _check_tags(tags: Any, kind: str, ids: list[int], name: str, domain: Mesh) -> None:
    measure, dim = {
        "cell": ("dx", domain.topology.dim),
        "exterior_facet": ("ds", domain.topology.dim - 1),
    }[kind]
    if not ids:
        return
    if tags is None or not hasattr(tags, "find"):
        raise InputError(
            f"the {name} has {measure}({ids[0]}), but the measure has no mesh tags: use "
            f"ufl.Measure('{measure}', domain=mesh, subdomain_data=tags)"
        )
    if tags.dim != dim:
        raise InputError(
            f"the subdomain_data of {measure} in the {name} tags entities of dimension {tags.dim}, "
            f"expected {dim}"
        )


def _dense_tags(tags: Any, size: int, ids: list[int]) -> NDArray[np.int64]:
    """Return the tag of each entity, where it is one of the ids."""
    dense = np.full(size, _NOWHERE)
    if tags is not None:
        used = np.isin(tags.values, ids) & (tags.indices < size)
        dense[tags.indices[used]] = tags.values[used]
    return dense


def _tag_everywhere(
    form: ufl.Form, kind: str, ids: list[int], tags: NDArray[np.int64]
) -> tuple[ufl.Form, list[int], NDArray[np.int64]]:
    """Replace "everywhere" in integrals of one kind by all tags in use and one for the rest.

    "Everywhere" would take in cells that are left out and, in some versions, facets between ranks.

    Returns
    -------
    tuple
        The form, its tags, and the tag of each entity where it is one of them.
    """
    rest = max(ids, default=0) + 1
    everywhere = (*ids, rest) if ids else rest
    integrals = []
    for integral in form.integrals():
        if integral.integral_type() == kind and integral.subdomain_id() == "everywhere":
            integral = integral.reconstruct(subdomain_id=everywhere)
        integrals.append(integral)
    form = ufl.Form(integrals)
    used = _tagged_ids(form, kind)
    if rest in used:
        tags = np.where(tags == _NOWHERE, rest, tags)
    return form, used, tags


def _bind(form: _PreparedForm, spaces: list[FunctionSpace], cells: Sequence[Numbers]) -> Any:
    """Bind a form to torn spaces and the cells of some parts."""
    chosen = np.sort(np.concatenate([np.zeros(0, dtype=np.int32), *cells]))
    # every tag of the form is named, also where these cells have nothing of it
    of_cells: dict[int, Numbers] = {}
    of_facets: dict[int, Numbers] = {}
    if form.cell_tag is not None:
        tag = form.cell_tag[chosen]
        of_cells = {t: chosen[tag == t] for t in form.cell_ids}
    if form.facet_tag is not None:
        tags = form.facet_tag[chosen]
        for t in form.facet_ids:
            row, facet = np.nonzero(tags == t)
            of_facets[t] = np.column_stack([chosen[row], facet]).astype(np.int32)
    return form.compiled.bind(spaces, of_cells, of_facets)


def _values_of_cells(function: Function) -> NDArray[np.float64]:
    """Return a coefficient's values (cells, v, block) on each cell of this rank."""
    space = function.function_space
    values = function.x.array.reshape(-1, space.dofmap.index_map_bs)
    return np.asarray(values[_compat.cell_dofs(space)], dtype=float)


def _block(
    indptr: NDArray[Any], indices: NDArray[Any], data: NDArray[np.float64], begin: int, end: int
) -> sp.csr_matrix:
    """Return a diagonal block; its data are a view of all blocks' data."""
    entries = slice(indptr[begin], indptr[end])
    local = (data[entries], indices[entries] - begin, indptr[begin : end + 1] - indptr[begin])
    return sp.csr_matrix(local, shape=(end - begin, end - begin))
