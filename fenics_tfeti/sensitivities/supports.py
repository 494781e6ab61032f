"""Where the values of a Function or a Constant are prescribed as displacements."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from dolfinx.fem import Constant, Function, FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti.system import Prescribed
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.sensitivities.forms import (
    FormsAtSolution,
    by_constant,
    by_function,
    check_dependence,
    check_parameter,
)
from fenics_tfeti.typing import Numbers, Vector


def prescribed_entries(
    space: FunctionSpace, bcs: Sequence[Any], prescribed: Prescribed, m: Function | Constant
) -> tuple[Numbers, Numbers]:
    """Return the dofs of this rank whose displacement is a value of m, and its position in m.

    Of a degree of freedom in several conditions it is the last one that counts. Values are numbered
    to see where they arrive: the conditions of no version of dolfinx tell.
    """
    nodes = NodeMap(space)
    block, size = nodes.components, nodes.components * nodes.size
    at = block * nodes.to_local(prescribed.nodes) + prescribed.components
    condition = np.full(size, -1)
    condition[at] = prescribed.condition
    dofs, entries = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    with _numbered(m) as set_first:
        for number, bc in enumerate(bcs):
            set_first(0.0)
            of_bc, low = _compat.bc_values(bc, size)
            set_first(1.0)
            high = _compat.bc_values(bc, size)[1]
            depends = (high != low) & (condition[of_bc] == number)
            dofs.append(np.asarray(of_bc)[depends].astype(np.int64))
            entries.append(low[depends].astype(np.int64))
    return np.concatenate(dofs), np.concatenate(entries)


@contextmanager
def _numbered(m: Function | Constant) -> Iterator[Any]:
    """Give a function that sets the values of m to numbers in a row; set them back in the end."""
    values: Vector = m.x.array if isinstance(m, Function) else m.value
    kept = np.array(values)

    def set_first(first: float) -> None:
        values[...] = first + np.arange(kept.size).reshape(kept.shape)

    try:
        yield set_first
    finally:
        values[...] = kept


def prescribed_changes(
    forms: FormsAtSolution, bcs: Sequence[Any], prescribed: Prescribed, data: Mapping[Any, Any]
) -> tuple[Vector, list[tuple[Function | Constant, Any]]]:
    """Return changes (n,) of prescribed displacements, and data that stand in forms. Collective."""
    space = forms.u.function_space
    size = space.dofmap.index_map.size_local * space.dofmap.index_map_bs
    changes, in_forms = np.zeros(size), []
    for m, dm in data.items():
        at, entries = prescribed_entries(space, bcs, prescribed, m)
        values = np.ravel(dm.x.array if isinstance(dm, Function) else dm)
        of_m = np.size(m.value if isinstance(m, Constant) else m.x.array)
        own, stands = at < size, forms.depend_on(m)
        changes[at[own]] = np.broadcast_to(values, of_m)[entries[own]]
        check_dependence(m, any_rank(space.mesh.comm, [at.size > 0]) or stands)
        if stands:
            in_forms.append((m, dm))
    return changes, in_forms


def derivative_by(
    m: Function | Constant,
    forms: FormsAtSolution,
    z: Function,
    supports: tuple[Sequence[Any], Prescribed],
    reaction: Callable[[], Vector],
) -> Vector:
    """Return the derivative of J by a Function or a Constant, with the adjoint z. Collective.

    The supports are Dirichlet conditions and what they prescribe, the reaction that by all
    prescribed displacements (n,), which this rank owns.
    """
    space = forms.u.function_space
    check_parameter(m)
    dofs, entries = prescribed_entries(space, *supports, m)
    is_support, stands = any_rank(space.mesh.comm, [dofs.size > 0]), forms.depend_on(m)
    check_dependence(m, is_support or stands)
    by_supports = reaction() if is_support else np.zeros(0)
    values = np.zeros(m.value.size if isinstance(m, Constant) else m.x.array.size)
    own = dofs < by_supports.size
    np.add.at(values, entries[own], by_supports[dofs[own]])
    work = forms.work(z)
    total: Vector
    if isinstance(m, Constant):
        total = space.mesh.comm.allreduce(values).reshape(m.ufl_shape)
        return total + by_constant(work, m, space.mesh) if stands else total
    total = _compat.summed_at_owners(values, m.function_space)
    return total + by_function(work, m) if stands else total
