"""From meshes, UFL forms and facet tags to a torn system; the only layer that uses dolfinx."""

# before anything else: it loads the MPI library that petsc4py and dolfinx need
import mpi4py.MPI  # noqa: F401
