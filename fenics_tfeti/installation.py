"""Versions and libraries of an installation: ``python -m fenics_tfeti``."""

from __future__ import annotations

import platform
import time
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.linalg.blas import dgemm

from fenics_tfeti.errors import ContactError, needs_fenicsx
from fenics_tfeti.feti.local.cholesky import available_packages
from fenics_tfeti.feti.report.report import versions
from fenics_tfeti.parallel import print_on_first_rank

# Rate of products of dense matrices below which BLAS is slow [operations/s]: the reference
# implementation reaches 1e9 to 3e9 on one core, others 1e10 and more.
_SLOW = 4e9

# Libraries of BLAS by their file names, and what to call them.
_LIBRARIES = {"openblas": "OpenBLAS", "mkl": "MKL", "blis": "BLIS", "atlas": "ATLAS"}


def facts(comm: MPI.Intracomm) -> dict[str, str]:
    """Return versions and libraries of the installation, by name. The same on all ranks."""
    packages = available_packages()
    entries = {"fenics_tfeti": _version("fenics_tfeti"), "Python": platform.python_version()}
    entries["dolfinx"] = _dolfinx()
    names = {"petsc": "PETSc", "mpi": "MPI", "numpy": "NumPy", "scipy": "SciPy"}
    entries |= {names[name]: " ".join(number.split()) for name, number in versions().items()}
    entries["BLAS"] = comm.bcast(blas())
    entries["sparse factors"] = ", ".join(packages) or "none: install PETSc with CHOLMOD or MUMPS"
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


def _rate() -> float:
    """Return the operations in a second of products of dense matrices; the best of some."""
    n, seconds = 384, list[float]()
    A = np.asfortranarray(np.ones((n, n)))
    for _ in range(6):
        begin = time.perf_counter()
        dgemm(1.0, A, A)
        seconds.append(time.perf_counter() - begin)
    return float(2.0 * n**3 / min(seconds))


def _loaded_libraries() -> list[str]:
    """Return the names of the files that are mapped into this process; none but on Linux."""
    maps = Path("/proc/self/maps")
    if not maps.is_file():
        return []
    paths = {line.split(maxsplit=5)[-1].strip() for line in maps.read_text().splitlines()}
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


def main(comm: MPI.Intracomm = MPI.COMM_WORLD) -> int:
    """Print the installation, run the self-test, and return 0 if it passes, else 1. Collective."""
    entries = facts(comm)
    lines = [f"{name:>16}  {value}" for name, value in entries.items()]
    print_on_first_rank(comm, "\n".join(lines))
    if "cannot be imported" in entries["dolfinx"]:
        return 1
    print_on_first_rank(comm, f"{'self-test':>16}  two blocks meshed apart ...")
    from fenics_tfeti.self_test import self_test

    try:
        result = self_test(comm)
    except ContactError as error:
        print_on_first_rank(comm, f"{'':>16}  FAILED: {error}")
        return 1
    verdict = "passed" if result.passed else "FAILED"
    print_on_first_rank(
        comm,
        f"{'':>16}  {verdict}: the pressure is exact to {result.error:.1e}, "
        f"{result.products} products with F, {result.seconds:.1f} s",
    )
    return 0 if result.passed else 1
