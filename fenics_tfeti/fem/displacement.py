"""The space of displacements: its checks, prescribed values, and the solution in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import ufl
from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.geometry.reference_cells import MESH_CELLS
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import SAME_VALUE
from fenics_tfeti.feti.system import Prescribed, Subdomain
from fenics_tfeti.parallel import raise_collectively, warn_on_first_rank
from fenics_tfeti.typing import Indices, Mask, Vector


def space_of_forms(a: ufl.Form, L: ufl.Form) -> FunctionSpace:
    """Return the space of a bilinear and a linear form, checked to be one of displacements."""
    arguments = a.arguments() + L.arguments()
    _check_linear_in_trial_function(a)
    if len(a.arguments()) != 2 or len(L.arguments()) != 1:
        raise InputError(
            f"a has {len(a.arguments())} arguments, L has {len(L.arguments())}: a has to be "
            "bilinear (trial and test function), L linear (test function)"
        )
    for name, form in (("a", a), ("L", L)):
        if not _compat.is_linear_in_arguments(form):
            raise InputError(
                f"{name} is not linear in its arguments: each term of a has to be linear in the "
                "trial function and in the test function, each term of L in the test function. "
                "ufl.lhs and ufl.rhs take a and L from their sum; of materials that are not "
                "linear elastic, a and L are those of one Newton step (ufl.derivative)"
            )
    space = arguments[0].ufl_function_space()
    if any(argument.ufl_function_space() != space for argument in arguments):
        raise InputError("the arguments of a and L are on different function spaces; use one")
    cell = _compat.cell_name(space.mesh)
    if cell not in MESH_CELLS:
        bars = ". Model bars and points as bodies in two or three dimensions"
        raise InputError(
            f"the mesh has cells of the type {cell}; supported are {', '.join(MESH_CELLS)}"
            f"{bars if cell in ('interval', 'point') else ''}"
        )
    family, degree, shape = _compat.element_facts(space)
    gdim = space.mesh.geometry.dim
    if shape != (gdim,):
        kind = "scalar" if shape == () else f"of shape {shape}"
        raise InputError(
            f"the function space is {kind}; a displacement needs {gdim} components, as in "
            f"functionspace(mesh, ('Lagrange', 1, ({gdim},)))"
        )
    if family != "Lagrange" or degree not in (1, 2):
        raise InputError(
            f"the function space is {family} of degree {degree}; Lagrange elements of degree 1 or "
            "2 are expected"
        )
    if space.mesh.topology.dim != gdim:
        raise InputError(
            f"the mesh has cells of dimension {space.mesh.topology.dim}; cells of the dimension "
            f"{gdim} of its coordinates are expected"
        )
    cell_degree = _compat.geometry_degree(space.mesh)
    if cell_degree > degree:
        curved = "2" if cell_degree == 2 else "3 or more"
        raise InputError(
            f"the mesh has curved cells, of degree {curved}, and the displacement is of degree "
            f"{degree}; take displacements of degree 2 on cells of degree 1 or 2, or cells of "
            "degree 1 (setOrder in Gmsh)"
        )
    return space


def _check_linear_in_trial_function(a: ufl.Form) -> None:
    """Check that a is no residual: a displacement that is a coefficient, and no trial function."""
    if len(a.arguments()) != 1:
        return
    space = a.arguments()[0].ufl_function_space()
    for coefficient in a.coefficients():
        if coefficient.ufl_function_space() == space:
            raise InputError(
                f"a has no trial function, but depends on the Function '{coefficient.name}' of the "
                "displacement's space: write it with u = ufl.TrialFunction(V). If a is the "
                "residual of a material that is not linear elastic, pass the forms of one Newton "
                "step: the residual's ufl.derivative as a, minus the residual as L"
            )


def prescribed_values(space: FunctionSpace, bcs: Sequence[Any]) -> Prescribed:
    """Evaluate Dirichlet conditions at this rank's degrees of freedom. Collective.

    Each has the number of its last condition. Contradictory values are errors; a condition that is
    empty on all ranks is a warning.
    """
    nodes = NodeMap(space)
    block, size = nodes.components, nodes.components * nodes.size
    prescribed = np.zeros(size, dtype=bool)
    values = np.zeros(size)
    condition = np.zeros(size, dtype=np.int64)
    counts = np.zeros(len(bcs), dtype=np.int64)
    with raise_collectively(space.mesh.comm):
        for number, bc in enumerate(bcs):
            if not _compat.bc_is_on(bc, space):
                raise InputError(
                    f"Dirichlet condition {number} is not on the displacement's function space or "
                    "one of its components"
                )
            dofs, new = _compat.bc_values(bc, size)
            _check_values(space, number, dofs, new, prescribed, values)
            prescribed[dofs] = True
            values[dofs] = new
            condition[dofs] = number
            counts[number] = len(dofs)
    empty = (
        f"Dirichlet condition {number} prescribes nothing, no degree of freedom is in it. "
        "Is there a facet with its tag, or a node at its place?"
        for number in np.flatnonzero(nodes.comm.allreduce(counts) == 0)
    )
    warn_on_first_rank(nodes.comm, *empty)
    unrolled = np.flatnonzero(prescribed)
    return Prescribed(
        nodes.to_global(unrolled // block),
        (unrolled % block).astype(np.int64),
        values[unrolled],
        condition[unrolled],
    )


def prescribed_components(nodes: NodeMap, prescribed: Prescribed) -> Mask:
    """Tell which components (n, gdim) of nodes that this rank owns are prescribed; no ghosts'."""
    mask = np.zeros((nodes.size, nodes.components), dtype=bool)
    local = prescribed.nodes - nodes.first
    owned = (local >= 0) & (local < nodes.owned)
    mask[local[owned], prescribed.components[owned]] = True
    return mask


def _check_values(
    space: FunctionSpace,
    number: int,
    dofs: Indices,
    new: Vector,
    prescribed: Mask,
    values: Vector,
) -> None:
    """Check the new values at some dofs against the values that are given already."""
    bad = ~np.isfinite(new)
    if bad.any():
        raise InputError(
            f"Dirichlet condition {number} has {np.count_nonzero(bad)} values that are NaN or "
            "infinite"
        )
    scale = max(np.abs(new).max(initial=0.0), np.abs(values).max(initial=0.0))
    wrong = dofs[prescribed[dofs] & (np.abs(values[dofs] - new) > SAME_VALUE * scale)]
    if wrong.size:
        block, gdim = space.dofmap.index_map_bs, space.mesh.geometry.dim
        x = space.tabulate_dof_coordinates()[:, :gdim]
        place = format_point(x[wrong[0] // block], float(np.abs(x).max()))
        raise InputError(
            f"contradictory Dirichlet values: component {wrong[0] % block} at {place} is "
            f"{values[wrong[0]]:g} by an earlier condition and {new[dofs == wrong[0]][0]:g} by "
            f"condition {number} ({wrong.size} such contradictions)"
        )


def fill_displacement(
    uh: Function, subdomains: Sequence[Subdomain], displacements: Sequence[Vector]
) -> Function:
    """Fill a function with the displacements of subdomains, and return it.

    The displacements (n_i,) of this rank's subdomains [m] are equal at all copies of a node; those
    of rigid bodies may follow. The function's ghosts are up to date.
    """
    nodes = NodeMap(uh.function_space)
    values = nodes.values(uh)
    for subdomain, displacement in zip(subdomains, displacements, strict=False):
        values[nodes.to_local(subdomain.nodes)] = displacement.reshape(-1, nodes.components)
    uh.x.scatter_forward()
    return uh


def owned_values(uh: Function) -> Vector:
    """Return the values of a function at the degrees of freedom that this rank owns."""
    nodes = NodeMap(uh.function_space)
    return uh.x.array[: nodes.owned * nodes.components].copy()


def fill_owned(uh: Function, values: Vector) -> Function:
    """Fill a function with the values that this rank owns, and return it. Collective."""
    uh.x.array[: values.size] = values
    uh.x.scatter_forward()
    return uh
