"""A shallow arch that snaps through: a path of equilibria with two limit points."""

from mpi4py import MPI

import numpy as np
import scenes
import scipy.sparse as sp
from scenes import Scene, at
from scipy.sparse.linalg import spsolve

import ufl
from dolfinx import fem
from dolfinx.fem import petsc

from fenics_tfeti import NonlinearContactProblem, Plane
from fenics_tfeti.models import neo_hookean

SUPPORTS, TOP, BOTTOM = 1, 2, 3


class Arch:
    """Half an arch of span 2 and rise 0.2, clamped, under a dead load near its middle."""

    def __init__(self, n=12, floor=None, comm=MPI.COMM_SELF, **options):
        def bent(x):
            return np.stack([x[0], x[1] + 0.2 * (1.0 - x[0] ** 2)])

        marks = [(SUPPORTS, at(0, 1.0)), (TOP, at(0, 0.0)), (BOTTOM, at(1, 0.0))]
        parts = [((0.0, 0.0), (1.0, 0.05), (n, 2))]
        bodies = Scene.of_boxes(comm, "quadrilateral", parts, marks, bent)
        bodies.fix(SUPPORTS)
        bodies.fix(TOP, 0)
        if floor is not None:
            bodies.add_obstacle(BOTTOM, Plane((0.0, floor), (0.0, 1.0)))
        self.u, self.load = fem.Function(bodies.V), fem.Constant(bodies.mesh, 0.0)
        # of one at the end of the arch
        work = -self.u[1] / 0.05 * bodies.ds(TOP)
        dx = ufl.dx(metadata={"quadrature_degree": 3})
        self.F = ufl.derivative(neo_hookean(1.0, 0.3)(self.u) * dx - self.load * work, self.u)
        self.lowering, self.bcs = fem.form(work), bodies.bcs
        self._lowering = fem.form(ufl.derivative(work, self.u))
        self.problem = NonlinearContactProblem(
            self.F, self.u, bcs=bodies.bcs, contacts=bodies.contacts, options=options
        )

    def set_load(self, t):
        self.load.value = t

    def on_path(self, lowered):
        """Return the load at which the end is lowered so far, by Newton's method with LU.

        It is the multiplier of that condition, and starts from `u`, which is not changed.
        """
        V, t = self.u.function_space, float(self.load.value)
        u = fem.Function(V)
        u.x.array[:] = self.u.x.array
        F = ufl.replace(self.F, {self.u: u, self.load: fem.Constant(V.mesh, 0.0)})
        residual, tangent = fem.form(F), fem.form(ufl.derivative(F, u, ufl.TrialFunction(V)))
        free = np.flatnonzero(np.isnan(scenes.reference.prescribed_values(V, self.bcs)))
        b = fem.assemble_vector(self._lowering).array[free]
        for _ in range(10):
            r = np.append(
                fem.assemble_vector(residual).array[free] - t * b, b @ u.x.array[free] - lowered
            )
            K = petsc.assemble_matrix(tangent)
            K.assemble()
            indptr, indices, data = K.getValuesCSR()
            K = sp.csr_matrix((data, indices, indptr))[free][:, free]
            step = spsolve(sp.bmat([[K, -b[:, None]], [b[None], None]], "csc"), r)
            u.x.array[free] -= step[:-1]
            t -= step[-1]
        assert np.abs(step[:-1]).max() < 1e-12
        return t

    def lowered(self):
        """Return the mean displacement of the loaded end downwards."""
        return self.u.function_space.mesh.comm.allreduce(fem.assemble_scalar(self.lowering))
