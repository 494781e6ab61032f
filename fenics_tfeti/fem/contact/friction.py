"""Values of laws of friction at the nodes of a contact."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.description import FrictionLaw
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import vertex_nodes
from fenics_tfeti.fem.user_data import scalars_at
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector


def values_at_nodes(
    space: FunctionSpace, law: FrictionLaw, nodes: NDArray[np.int64], points: Vector, name: str
) -> Vector:
    """Return a law's bound or coefficient (k,), at least 0, at nodes of this rank. Collective.

    The nodes (k,) are global ones, at vertices.
    """
    ((label, value),) = vars(law).items()
    label = f"{name}: {label}"
    comm, gdim = space.mesh.comm, space.dofmap.index_map_bs
    with raise_collectively(comm):
        if isinstance(value, Function):
            value = _nodal_values(space, value, nodes, label)
    return scalars_at(comm, value, points, gdim, label, lowest=0.0)


def _nodal_values(
    space: FunctionSpace, function: Function, nodes: NDArray[np.int64], label: str
) -> Vector:
    source = function.function_space
    if source.mesh is not space.mesh:
        raise InputError(f"{label} is a Function on another mesh than the displacement")
    family, degree, shape = _compat.element_facts(source)
    if (family, degree) != ("Lagrange", 1) or shape:
        raise InputError(
            f"{label} is a Function of {family} elements of degree {degree} and shape {shape}; a "
            "scalar one of Lagrange elements of degree 1 is expected"
        )
    # the two spaces may number their nodes differently
    dofs = np.zeros(int(_compat.cell_dofs(space).max(initial=-1)) + 1, dtype=np.int64)
    dofs[vertex_nodes(space)] = vertex_nodes(source)
    values: Vector = function.x.array[dofs[nodes - NodeMap(space).first]]
    return values
