"""Say in one line what an environment holds; fail if it does not work."""

from mpi4py import MPI

import petsc4py

petsc4py.init()

import numpy as np
import scipy

import dolfinx

print(
    f"dolfinx {dolfinx.__version__}, petsc4py {petsc4py.__version__}, numpy {np.__version__}, "
    f"scipy {scipy.__version__}, {MPI.Get_library_version().splitlines()[0].split(',')[0]}"
)
with open("/proc/self/maps") as maps:
    libraries = {line.split()[-1] for line in maps if "/libblas.so" in line}
if any("openblas" not in name for name in libraries):
    print(
        f"warning: the BLAS in use is {', '.join(sorted(libraries))}, which is slow; choose "
        "OpenBLAS with: update-alternatives --config libblas.so.3-$(uname -m)-linux-gnu"
    )
