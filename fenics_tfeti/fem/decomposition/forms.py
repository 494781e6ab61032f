"""The user's forms, checked and compiled once, to be integrated over any of this rank's cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import ufl
from dolfinx.fem import Function
from dolfinx.mesh import Mesh
from ufl import geometry
from ufl.corealg.traversal import traverse_unique_terminals

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.assembly_loops import assembly_library
from fenics_tfeti.fem.topology import NO_TAG, cell_facets, dense_tags, owned_cells
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Array, Indices, Mask, Numbers, Vector

# geometric quantities of UFL that a translation does not change
_TRANSLATION_INVARIANT = (
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
# UFL's measures by the kind of their integrals
_MEASURES = {"cell": "dx", "exterior_facet": "ds"}
# in place of a tag, in compiled forms too, and of its number
_EVERYWHERE = -1
# number where a form has no integral
_NOWHERE = -2


@dataclass(frozen=True)
class PreparedForm:
    """A compiled form, with the tags of its integrals on the user's cells and facets."""

    name: str  # for messages
    form: ufl.Form
    compiled: list[_compat.CompiledForm]  # of which it is the sum
    ids: dict[str, list[int]]  # by kind of integral the tags that integrals name
    # by kind of integral, for each cell (m,) or facet of it (m, f): the position of its tag among
    # these, _EVERYWHERE for others that are integrated over, or _NOWHERE; in the shortest integers
    numbers: dict[str, Numbers]
    translation_invariant: bool  # a translated cell has the same element matrix

    def integrated(self, cells: Indices) -> Mask:
        """Tell which of some of this rank's cells the form has integrals over, or over facets."""
        mask = np.zeros(cells.size, dtype=bool)
        for kind, tag in _integrals(self.compiled):
            mask[self._entities(kind, tag, cells)[0]] = True
        return mask

    def has_tag(self, kind: str, cells: Indices, tags: Sequence[int] | None) -> Mask:
        """Tell which of some of this rank's cells have one of some tags; None are all cells."""
        if tags is None:
            return np.ones(cells.size, dtype=bool)
        chosen = [self.ids[kind].index(tag) for tag in tags]
        return np.isin(self.numbers[kind][cells], chosen)

    def restricted(self, kind: str, facet: int | None = None) -> PreparedForm:
        """Return the part of the form over cells, or over facets with one local number."""
        numbers = {other: np.full_like(values, _NOWHERE) for other, values in self.numbers.items()}
        if kind in numbers:
            on = slice(None) if facet is None else (slice(None), facet)
            numbers[kind][on] = self.numbers[kind][on]
        return replace(self, numbers=numbers)

    def _entities(self, kind: str, tag: int, cells: Indices) -> tuple[Indices, ...]:
        """Return the rows of the cells that an integral is over, or those of facets and these."""
        numbers = self.numbers[kind][cells]
        if tag == _EVERYWHERE:
            return np.nonzero(numbers != _NOWHERE)
        return np.nonzero(numbers == self.ids[kind].index(tag))

    def element_tensors(self, domain: Mesh, n: int, cells: Indices) -> Vector:
        """Return the vectors (m, n) or matrices (m, n, n) of some cells, their nodes in order."""
        tensors = np.zeros((cells.size, *(n,) * len(self.form.arguments())))
        coordinates = domain.geometry.x[_compat.geometry_cells(domain)[cells]]
        for compiled in self.compiled:
            values = [_values_of_cells(w, cells) for w in compiled.coefficients]
            coefficients = np.hstack([np.zeros((cells.size, 0)), *map(flat_rows, values)])
            for kind, tag, kernel in compiled.integrals:
                rows, *facet = self._entities(kind, tag, cells)
                facets = facet[0].astype(np.int32) if facet else None
                if rows.size:
                    compiled.add_element_tensors(
                        kernel, tensors, rows, coefficients, coordinates, facets
                    )
        return tensors

    def values(self) -> list[Vector]:
        """Return copies of the coefficients' and constants' present values; NaN is an error."""
        _check_values(self.name, self.form)
        coefficients = [np.array(w.x.array, dtype=float) for w in self.form.coefficients()]
        return coefficients + [np.array(c.value, dtype=float) for c in self.form.constants()]

    def cell_data(self) -> list[Array]:
        """Return tags and coefficients (cells, ...) by which the element matrices may differ."""
        return [*self.numbers.values(), *map(_values_of_cells, self.form.coefficients())]


def prepare_form(
    domain: Mesh,
    form: ufl.Form,
    name: str,
    exterior: Mask,
    compiler: _compat.CompilerOptions | None = None,
) -> PreparedForm:
    """Check and compile a form, and look up the tags of its measures. Collective.

    `name` is that of the form in messages; `exterior` (cells, facets of a cell) marks the facets of
    owned cells that are on the boundary of the mesh.
    """
    ids = {kind: _tagged_ids(form, kind) for kind in _MEASURES}
    with raise_collectively(domain.comm):
        for kind in (integral.integral_type() for integral in form.integrals()):
            if kind not in _MEASURES:
                raise InputError(
                    f"the {name} has an integral over {kind}; only dx and ds are supported, since "
                    "subdomains are torn from each other"
                )
        _check_coefficients(form, name, domain)
        assembly_library()
        data = {kind: _subdomain_data(form, kind, ids[kind], name, domain) for kind in _MEASURES}

    owned, facets = owned_cells(domain), cell_facets(domain)
    on_facets = dense_tags(data["exterior_facet"], int(facets.max(initial=-1)) + 1)[facets[:owned]]
    tags = {"cell": dense_tags(data["cell"], owned), "exterior_facet": on_facets}
    integrated = {"cell": np.ones(owned, dtype=bool), "exterior_facet": exterior}
    for kind, tag in tags.items():
        present = tag[integrated[kind] & (tag != NO_TAG)]
        _check_used(domain, present, ids[kind], f"the {name} has {_MEASURES[kind]}")
    compiled = [_compat.CompiledForm(part, domain, compiler) for part in _split_by_rules(form)]
    integrals, numbers = _integrals(compiled), {}
    for kind in dict(integrals):
        others = _EVERYWHERE if (kind, _EVERYWHERE) in integrals else _NOWHERE
        numbers[kind] = _numbered(tags[kind], ids[kind], others)
        numbers[kind][~integrated[kind]] = _NOWHERE
    return PreparedForm(name, form, compiled, ids, numbers, _is_translation_invariant(form))


def _split_by_rules(form: ufl.Form) -> list[ufl.Form]:
    """Split a form into forms with one quadrature rule for each kind of integral.

    FFCx 0.5 takes values at the points of one rule for those of another in the same kernel.
    """
    rules, parts = dict[str, list[str]](), dict[int, list[ufl.Integral]]()
    for integral in form.integrals():
        of_kind = rules.setdefault(integral.integral_type(), [])
        rule = repr(sorted(integral.metadata().items()))
        if rule not in of_kind:
            of_kind.append(rule)
        parts.setdefault(of_kind.index(rule), []).append(integral)
    return [ufl.Form(parts[number]) for number in sorted(parts)] if len(parts) > 1 else [form]


def _integrals(compiled: Sequence[_compat.CompiledForm]) -> list[tuple[str, int]]:
    """Return kind and tag of each integral of compiled forms, each once."""
    integrals = (integral[:2] for form in compiled for integral in form.integrals)
    return list(dict.fromkeys(integrals))


def _numbered(tags: Numbers, ids: list[int], others: int) -> Numbers:
    """Return the positions of tags among some that ascend, and `others` for those that are not."""
    numbers = np.searchsorted(ids, tags).astype(np.min_scalar_type(-len(ids) + _NOWHERE))
    numbers[~np.isin(tags, ids)] = others
    return numbers


def _is_translation_invariant(form: ufl.Form) -> bool:
    return all(
        isinstance(terminal, _TRANSLATION_INVARIANT)
        for integral in form.integrals()
        for terminal in traverse_unique_terminals(integral.integrand())
        if isinstance(terminal, geometry.GeometricQuantity)
    )


def _check_coefficients(form: ufl.Form, name: str, domain: Mesh) -> None:
    for number, coefficient in enumerate(form.coefficients()):
        label = _label(number, coefficient, name)
        W = coefficient.function_space
        if _compat.cpp_object(W.mesh) is not _compat.cpp_object(domain):
            raise InputError(f"{label} is on another mesh than the displacement")
        family, degree, _ = _compat.element_facts(W)
        # a number on the whole mesh is the constant of dolfinx-adjoint
        is_known = "Discontinuous" in family or family == "real"
        if not is_known and not (family == "Lagrange" and degree <= 2):
            raise InputError(
                f"{label} has the element {family} of degree {degree}; coefficients may be "
                "discontinuous Lagrange of any degree, or Lagrange of degree 1 or 2: interpolate "
                "it into such a space"
            )
    _check_values(name, form)


def _check_values(name: str, form: ufl.Form) -> None:
    for number, coefficient in enumerate(form.coefficients()):
        bad = np.count_nonzero(~np.isfinite(coefficient.x.array))
        if bad:
            raise InputError(
                f"{_label(number, coefficient, name)} has {bad} values that are NaN or infinite"
            )
    for number, constant in enumerate(form.constants()):
        if not np.isfinite(constant.value).all():
            raise InputError(
                f"constant {number} of the {name} is NaN or infinite: {constant.value}"
            )


def _label(number: int, coefficient: Function, name: str) -> str:
    return f"coefficient {number} ({getattr(coefficient, 'name', 'unnamed')}) of the {name}"


def _tagged_ids(form: ufl.Form, kind: str) -> list[int]:
    """Return the tags that a form's integrals of one kind are limited to."""
    ids = [i.subdomain_id() for i in form.integrals() if i.integral_type() == kind]
    named = [tags for tags in ids if tags not in ("everywhere", "otherwise")]
    return sorted({tag for tags in named for tag in np.atleast_1d(tags).tolist()})


def _subdomain_data(form: ufl.Form, kind: str, ids: list[int], name: str, domain: Mesh) -> Any:
    """Return the tags that the measures of one kind have, checked; None without any."""
    data = [i.subdomain_data() for i in form.integrals() if i.integral_type() == kind]
    different = list({id(tags): tags for tags in data if tags is not None}.values())
    measure, dim = _MEASURES[kind], domain.topology.dim - (kind != "cell")
    if len(different) > 1:
        raise InputError(
            f"the {name} has {len(different)} different subdomain_data for {measure}: join their "
            "tags in one, since a form has one for each kind of integral"
        )
    tags = different[0] if different else None
    if not ids:
        return tags
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
    if not _compat.tags_are_on(tags, domain):
        raise InputError(
            f"the subdomain_data of {measure} in the {name} are tags of another mesh than the "
            "displacement"
        )
    return tags


def _check_used(domain: Mesh, present: Numbers, ids: list[int], which: str) -> None:
    """Check that each tag that a form names is present where integrals are over. Collective."""
    if not ids:
        return
    present = np.unique(concatenate_ranks(domain.comm, np.unique(present)))
    missing = np.setdiff1d(ids, present)
    if missing.size:
        on = "cell" if which.endswith("dx") else "facet of the mesh's boundary"
        raise InputError(
            f"{which}({missing[0]}), but tag {missing[0]} is on no {on}; the tags there are "
            f"{present.tolist()}"
        )


def flat_rows(values: Vector) -> Vector:
    """Return values (m, ...) as (m, n), also of no cells."""
    return values.reshape(len(values), int(np.prod(values.shape[1:])))


def _values_of_cells(function: Function, cells: Indices | slice = slice(None)) -> Vector:
    """Return a coefficient's values (cells, v, block) on some cells of this rank, or on all."""
    space = function.function_space
    values = function.x.array.reshape(-1, space.dofmap.index_map_bs)
    return np.asarray(values[_compat.cell_dofs(space)[cells]], dtype=float)
