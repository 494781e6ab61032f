"""The user's mesh torn into subdomains, with what was assembled on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.fem.decomposition.assembly import FormValues, PreparedForms, same_values
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.decomposition.parts import Part, number_parts
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.typing import Indices, Vector


class TornMesh:
    """Subdomains of a mesh, by their cells; collective.

    Those of rigid bodies are left out. The others are assembled again only where something changed.
    Coordinates `x` (dofs, 3) are those of the blocked degrees of freedom [m].
    """

    def __init__(
        self, forms: PreparedForms, bodies: Bodies, cells: list[Indices], x: Vector, timer: Timer
    ) -> None:
        self.forms, self._space, self._bodies, self._timer = forms, forms.space, bodies, timer
        self._cells, self._rigid_cells = list[Indices](), list[Indices]()
        for part in cells:
            is_rigid = bodies.of_cell[part[0]] >= bodies.deformable
            (self._rigid_cells if is_rigid else self._cells).append(part)
        self.place_nodes(x)

    def place_nodes(self, x: Vector) -> None:
        """Take the nodes where they are now; all is assembled anew."""
        with self._timer.phase("partition"):
            self._parts = self._numbered(self._cells, x)
            self._rigid_parts = self._numbered(self._rigid_cells, x)
        self._values: FormValues | None = None  # with which the subdomains were assembled
        self._subdomains: list[Subdomain] = []
        # last: after an error above, the nodes count as moved in the next solve too
        self._nodes, self._x = x, self._space.mesh.geometry.x.copy()

    def _numbered(self, cells: Sequence[Indices], x: Vector) -> list[Part]:
        bodies = [self._bodies.of_cell[part[0]] for part in cells]
        return number_parts(self._space, cells, bodies, x)

    @property
    def subdomains(self) -> list[Subdomain]:
        """The subdomains as they were assembled last."""
        return list(self._subdomains)

    def has_moved(self) -> bool:
        """Tell whether nodes were moved since `place_nodes`."""
        domain = self._space.mesh
        return not same_values([self._x], [domain.geometry.x], domain.comm)

    def assemble(self, release: Callable[[], None]) -> list[Subdomain]:
        """Assemble what changed: the loads, or all after `release` of what the caller holds."""
        comm, old, new = self._space.mesh.comm, self._values, self.forms.values()
        self._values = None  # after an error all is assembled anew
        if old is None or not same_values(old.bilinear, new.bilinear, comm):
            self._subdomains = []
            release()
            self._subdomains = self._assembled(None)
            if old is None:
                # most problems are assembled once
                for part in self._parts:
                    part.patterns.clear()
        elif not same_values(old.linear, new.linear, comm):
            self._subdomains = self._assembled(self._subdomains)
        self._values = new
        return self.subdomains

    def _assembled(self, known: Sequence[Subdomain] | None) -> list[Subdomain]:
        with self._timer.phase("assembly"):
            return self.forms.subdomains(self._parts, known, self._nodes)

    def matrices(self, forms: PreparedForms) -> list[sp.csr_matrix]:
        """Return the matrices of other forms on the subdomains. Collective."""
        with self._timer.phase("assembly"):
            return [forms.stiffness(part) for part in self._parts]

    def load(self, forms: PreparedForms | None = None) -> Vector:
        """Return the load (nodes, gdim) at the nodes that this rank owns now [N]. Collective."""
        return self._load(forms or self.forms, self._parts)

    def rigid_load(self) -> Vector:
        """Return the load (nodes, gdim) on the cells of rigid bodies, as of `load`. Collective."""
        return self._load(self.forms, self._rigid_parts)

    def _load(self, forms: PreparedForms, parts: Sequence[Part]) -> Vector:
        nodes = NodeMap(self._space)
        with self._timer.phase("assembly"):
            loads = forms.loads(parts)
            at = [np.zeros(0, dtype=np.int32), *(part.nodes for part in parts)]
            values = np.concatenate([np.zeros(0), *loads]).reshape(-1, nodes.components)
            return nodes.sum_at_owners(nodes.to_global(np.concatenate(at)), values)
