"""``python -m fenics_tfeti``: what the installation has, and a self-test."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from timeit import repeat
from typing import Any

from fenics_tfeti.errors import ContactError, needs_fenicsx

try:
    with needs_fenicsx("python -m fenics_tfeti"):
        from mpi4py import MPI

        import numpy as np
        from scipy.linalg.blas import dgemm

        from fenics_tfeti.feti.factors.cholesky import available_packages, describe_package
        from fenics_tfeti.feti.report.report import versions
        from fenics_tfeti.parallel import print_on_first_rank
except ImportError as error:
    sys.exit(str(error))

# Rate of products of dense matrices below which BLAS is slow [operations/s]: the reference
# implementation reaches 1e9 to 3e9 on one core, others 1e10 and more.
_SLOW = 4e9

# Variables that set the number of threads of BLAS, the first one before the others.
_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")

# Libraries of BLAS by their file names, and what to call them.
_LIBRARIES = {"openblas": "OpenBLAS", "mkl": "MKL", "blis": "BLIS", "atlas": "ATLAS"}


def facts(comm: MPI.Intracomm) -> dict[str, str]:
    """Return versions and libraries of the installation, by name. The same on all ranks."""
    entries = {"fenics_tfeti": _version("fenics_tfeti"), "Python": platform.python_version()}
    entries["dolfinx"] = _dolfinx()
    names = {"petsc": "PETSc", "mpi": "MPI", "numpy": "NumPy", "scipy": "SciPy"}
    entries["PETSc"] = "no petsc4py (for factors by CHOLMOD and MUMPS, and options in its database)"
    entries |= {names[name]: " ".join(number.split()) for name, number in versions().items()}
    entries["BLAS"] = comm.bcast(blas())
    processes = comm.Split_type(MPI.COMM_TYPE_SHARED).size
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    cores = os.cpu_count() or 1
    entries["threads"] = comm.bcast(threads(processes, cores, load, os.environ))
    packages = "; ".join(map(describe_package, available_packages()))
    entries["sparse factors"] = comm.bcast(packages) or "none: pip install rslab"
    extras = {"gmsh": "mesh files", "pyvista": "pictures", "matplotlib": "curves"}
    entries |= {name: extra(name, purpose) for name, purpose in extras.items()}
    entries["processes"] = str(comm.size)
    return entries


def extra(package: str, purpose: str) -> str:
    """Return the version of an optional package, or its purpose where it is missing."""
    return _version(package) if find_spec(package) else f"not installed (for {purpose})"


def blas(rate: float | None = None, loaded: Sequence[str] | None = None) -> str:
    """Return the libraries of BLAS that a process uses, and how fast products are.

    By default the rate [operations/s] is measured, which takes a tenth of a second, and the shared
    libraries are those of this process.
    """
    rate = _rate() if rate is None else rate
    loaded = _loaded_libraries() if loaded is None else loaded
    names = [name for part, name in _LIBRARIES.items() if any(part in file for file in loaded)]
    remedy = "" if names else ": install OpenBLAS, for instance libopenblas0-pthread"
    if not names and any("libblas.so" in file for file in loaded):
        names = ["reference BLAS"]
    text = f"{' and '.join(names) or 'unknown library'}, {rate / 1e9:.1f} Gflop/s"
    return text if rate >= _SLOW else f"{text} (slow{remedy or ': is the processor busy?'})"


def threads(processes: int, cores: int, load: float, environment: Mapping[str, str]) -> str:
    """Return how many threads BLAS takes in each process of a machine, and whether they are many.

    The load is the number of processes that use the machine's cores already.
    """
    given = (environment.get(name, "").split(",")[0] for name in _THREADS)
    number = next((int(text) for text in given if text.isdigit()), cores)
    busy = round(load)
    text = f"{number} for BLAS in each process, {cores} cores, {busy} of them busy"
    if number > 1 and number * processes + busy > cores:
        text += " (too many: threads wait for each other where cores are busy. OMP_NUM_THREADS=1)"
    return text


def _rate() -> float:
    """Return the operations in a second of products of dense matrices; the best of some."""
    A = np.ones((384, 384), order="F")
    return 2.0 * len(A) ** 3 / min(repeat(lambda: dgemm(1.0, A, A), number=1, repeat=6))


def _loaded_libraries() -> list[str]:
    """Return the names of the files that are mapped into this process; none but on Linux."""
    maps = Path("/proc/self/maps")
    lines = maps.read_text().splitlines() if maps.is_file() else []
    paths = {line.split(maxsplit=5)[-1].strip() for line in lines}
    return sorted(Path(path).name for path in paths if path.startswith("/"))


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "installed, without a version"


def _dolfinx() -> str:
    try:
        with needs_fenicsx("fenics_tfeti.fem"):
            from fenics_tfeti.fem import _compat
    except ImportError as error:
        reason = " ".join(str(error).split())
        return f"cannot be imported: only fenics_tfeti.feti and .qp can be used ({reason})"
    return _compat.version()


def self_test(comm: MPI.Intracomm) -> tuple[float, int, float]:
    """Press a block on another one that is meshed apart; the exact pressure is uniform. Collective.

    Return the largest error of the pressures, relative to the exact one, the products with F, and
    the wall time [s], most of it for the compilation of forms.
    """
    import ufl
    from dolfinx import fem

    from fenics_tfeti import ContactProblem
    from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
    from fenics_tfeti.models import isotropic, symmetry_plane

    begin = time.perf_counter()
    solids = [Box((0, 0, 0), (1, 1, 1), (5, 5, 3)), Box((0, 0, 1), (1, 1, 2), (4, 4, 3))]
    blocks = boxes(comm, solids, "hexahedron")
    top, sides = 3, range(3)  # the sides are on the planes of coordinates
    markers: dict[int, Any] = {k: lambda x, k=k: np.isclose(x[k], 0) for k in sides}
    facet_tags = tag_facets(blocks.mesh, {**markers, top: lambda x: np.isclose(x[2], 2)})
    V = displacement_space(blocks.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    pressure = 1e-3
    ds = ufl.Measure("ds", domain=blocks.mesh, subdomain_data=facet_tags)
    problem = ContactProblem(
        ufl.inner(isotropic(2.0, 0.25)(u), ufl.grad(v)) * ufl.dx,
        -fem.Constant(blocks.mesh, pressure) * v[2] * ds(top),
        bcs=[symmetry_plane(V, facet_tags, tag=axis, axis=axis) for axis in sides],
        contacts="auto",
        cell_tags=blocks.cell_tags,
        options={"rtol": 1e-9, "subdomain_size": 200},
    )
    problem.solve()
    error = float(np.abs(problem.results[0].gather().pressure / pressure - 1.0).max())
    seconds = comm.allreduce(time.perf_counter() - begin, MPI.MAX)
    return error, problem.report.products["total"], seconds


def main(comm: MPI.Intracomm = MPI.COMM_WORLD) -> int:
    """Print the installation, run the self-test, and return 0 if it passes, else 1. Collective."""
    entries = facts(comm)
    lines = [f"{name:>16}  {value}" for name, value in entries.items()]
    print_on_first_rank(comm, "\n".join(lines))
    if "cannot be imported" in entries["dolfinx"]:
        return 1
    print_on_first_rank(comm, f"{'self-test':>16}  two blocks meshed apart ...")
    try:
        error, products, seconds = self_test(comm)
    except ContactError as failure:
        print_on_first_rank(comm, f"{'':>16}  FAILED: {failure}")
        return 1
    verdict = "passed" if error <= 1e-6 else "FAILED"
    print_on_first_rank(
        comm,
        f"{'':>16}  {verdict}: the pressure is exact to {error:.1e}, {products} products with F, "
        f"{seconds:.1f} s",
    )
    return 0 if verdict == "passed" else 1


if __name__ == "__main__":
    sys.exit(main())
