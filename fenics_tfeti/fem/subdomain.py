"""One subdomain's mesh, and the user's forms bound to it: K_i and f_i (sec. 11.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

import ufl
from dolfinx import fem
from dolfinx.fem import Function, FunctionSpace
from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.partition import cell_facets, exterior_cell_facets
from fenics_tfeti.feti import Subdomain
from fenics_tfeti.feti.exchange import together

__all__ = ["BoundForms", "FormValues", "prepare_forms", "same_values"]

Numbers = NDArray[np.int32]

_SUPPORTED = ("cell", "exterior_facet")
# no tag: cells and facets are only ever tagged with what the form integrates over
_NOWHERE = np.iinfo(np.int64).min


@dataclass(frozen=True)
class _Submesh:
    """A mesh of some of the user's cells, on this process alone.

    Attributes
    ----------
    mesh : Mesh
        The mesh.
    cells : (cells,) integer array
        The user's cell of each of its cells.
    """

    mesh: Mesh
    cells: Numbers


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
        Tag of each cell, where integrals over cells are tagged.
    facet_tag : (cells, facets of a cell) integer array or None
        Tag of each facet of each cell, on the boundary of the bodies only.
    cell_ids, facet_ids : list of int
        The tags that the form's integrals name.
    """

    name: str
    compiled: _compat.CompiledForm
    coefficients: list[Function]
    constants: list[Any]
    cell_tag: NDArray[np.int64] | None
    facet_tag: NDArray[np.int64] | None
    cell_ids: list[int]
    facet_ids: list[int]


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
    """The user's forms, ready to be bound to any of this rank's cells.

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

    def subdomain(self, cells: Numbers, body: int, known: Subdomain | None = None) -> Subdomain:
        """Assemble K_i and f_i of some of this rank's cells.

        Parameters
        ----------
        cells : (m,) integer array
            The cells, connected through facets.
        body : int
            Their body.
        known : Subdomain, optional
            The same subdomain at an earlier time: all but f_i is taken from it.

        Returns
        -------
        Subdomain
            With the node numbers of the user's space.
        """
        sub = _submesh(self.space.mesh, cells)
        V = _compat.space_like(sub.mesh, self.space)
        load = _compat.assemble_load(_bind(self.linear, sub, [V]))
        if known is not None:
            return replace(known, load=load)
        indptr, indices, data = _compat.assemble_stiffness(_bind(self.bilinear, sub, [V, V]))
        gdim = self.space.dofmap.index_map_bs
        return Subdomain(
            sp.csr_matrix((data, indices, indptr)),
            load,
            np.ascontiguousarray(V.tabulate_dof_coordinates()[:, :gdim]),
            self._global_nodes(sub, V),
            body,
        )

    def values(self) -> FormValues:
        """Return the present values of all that the forms depend on.

        Raises
        ------
        InputError
            NaN in coefficients and constants.
        """
        with together(self.space.mesh.comm):
            return FormValues(_values(self.bilinear), _values(self.linear))

    def _global_nodes(self, sub: _Submesh, V: FunctionSpace) -> NDArray[np.int64]:
        local = _parent_dofs(self.space, V, sub)
        to_global = self.space.dofmap.index_map.local_to_global
        return np.asarray(to_global(local), dtype=np.int64)


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
    with together(domain.comm):
        _check_integrals(form, name)
        _check_data(form, name, domain)
    data = _compat.subdomain_data(form)
    cell_ids = _tagged_ids(form, "cell")
    facet_ids = _tagged_ids(form, "exterior_facet")
    with together(domain.comm):
        for kind, ids in (("cell", cell_ids), ("exterior_facet", facet_ids)):
            _check_tags(data.get(kind), kind, ids, name, domain)

    owned = domain.topology.index_map(domain.topology.dim).size_local
    cell_tag = _dense_tags(data.get("cell"), owned, cell_ids) if cell_ids else None
    facet_tag = None
    if any(i.integral_type() == "exterior_facet" for i in form.integrals()):
        facet_of, _ = cell_facets(domain)
        of_facet = _dense_tags(
            data.get("exterior_facet"), int(facet_of.max(initial=-1)) + 1, facet_ids
        )
        form, rest = _tag_everywhere(form, facet_ids)
        of_facet = np.where(of_facet == _NOWHERE, rest, of_facet)
        facet_tag = np.where(exterior, of_facet[facet_of[:owned]], _NOWHERE)
        facet_ids = _tagged_ids(form, "exterior_facet")
    return _PreparedForm(
        name,
        _compat.CompiledForm(form, domain.comm),
        list(form.coefficients()),
        list(form.constants()),
        cell_tag,
        facet_tag,
        cell_ids,
        facet_ids,
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


def _tag_everywhere(form: ufl.Form, ids: list[int]) -> tuple[ufl.Form, int]:
    """Replace "everywhere" in exterior facet integrals by all tags in use and one for the rest.

    On a submesh, "everywhere" would take in the interfaces to other subdomains.
    """
    rest = max(ids, default=0) + 1
    integrals = []
    for integral in form.integrals():
        on_facets = integral.integral_type() == "exterior_facet"
        if on_facets and integral.subdomain_id() == "everywhere":
            integral = integral.reconstruct(subdomain_id=(*ids, rest) if ids else rest)
        integrals.append(integral)
    return ufl.Form(integrals), rest


def _submesh(domain: Mesh, cells: Numbers) -> _Submesh:
    """Make a mesh of some cells on this process; the order of vertices in each cell is kept."""
    geometry = _compat.geometry_cells(domain)[cells]
    nodes, local = np.unique(geometry, return_inverse=True)
    x = domain.geometry.x[nodes, : domain.geometry.dim]
    sub = _compat.distributed_mesh(
        MPI.COMM_SELF,
        local.reshape(geometry.shape).astype(np.int64),
        np.ascontiguousarray(x),
        _compat.cell_name(domain),
    )
    return _Submesh(sub, cells[np.asarray(sub.topology.original_cell_index)])


def _bind(form: _PreparedForm, sub: _Submesh, spaces: list[FunctionSpace]) -> Any:
    coefficients = {w: _restrict(w, sub) for w in form.coefficients}
    # every tag of the form is named, also where this subdomain has nothing of it
    cells: dict[int, Numbers] = {}
    facets: dict[int, Numbers] = {}
    if form.cell_tag is not None:
        tag = form.cell_tag[sub.cells]
        cells = {t: np.flatnonzero(tag == t).astype(np.int32) for t in form.cell_ids}
    if form.facet_tag is not None:
        tags = form.facet_tag[sub.cells]
        facets = {t: np.argwhere(tags == t).astype(np.int32) for t in form.facet_ids}
    return form.compiled.bind(sub.mesh, spaces, coefficients, cells, facets)


def _parent_dofs(parent: FunctionSpace, child: FunctionSpace, sub: _Submesh) -> Numbers:
    """Return the parent's (blocked) degree of freedom of each of the child's.

    Cell by cell they are in the same order, for elements without orientation.
    """
    dofs = _compat.cell_dofs(child)
    parents = np.empty(int(dofs.max()) + 1, dtype=np.int32)
    parents[dofs] = _compat.cell_dofs(parent)[sub.cells]
    return parents


def _restrict(function: Function, sub: _Submesh) -> Function:
    """Return a coefficient on a submesh."""
    W = function.function_space
    child = _compat.space_like(sub.mesh, W)
    restricted = fem.Function(child)
    block = W.dofmap.index_map_bs
    parents = _parent_dofs(W, child, sub)
    restricted.x.array[:] = function.x.array.reshape(-1, block)[parents].ravel()
    return restricted
