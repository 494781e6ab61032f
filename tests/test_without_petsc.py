"""Solves where petsc4py is not installed, in a process that cannot import it."""

from importlib.util import find_spec

from mpi4py import MPI

import numpy as np
import pytest
from new_process import run_python
from scenes import two_beams

from dolfinx import fem

from fenics_tfeti.feti.factors.cholesky import available_packages

WITHOUT = "import sys\nsys.modules['petsc4py'] = None\n"
SOLVE = """
from mpi4py import MPI
from scenes import two_beams
problem = two_beams(MPI.COMM_SELF, "quadrilateral", 2).problem(options={"rtol": 1e-12})
"""

needs_rslab = pytest.mark.skipif(find_spec("rslab") is None, reason="no factor without PETSc")
needs_dolfinx = pytest.mark.skipif(
    not hasattr(fem, "functionspace"), reason="dolfinx 0.5.2 imports petsc4py itself"
)


@needs_rslab
@needs_dolfinx
def test_contact_is_that_with_petsc(tmp_path):
    other = next(package for package in reversed(available_packages()) if package != "rslab")
    options = {"rtol": 1e-12, "factor": other}
    with_petsc = two_beams(MPI.COMM_SELF, "quadrilateral", 2).problem(options=options).solve()
    file = tmp_path / "displacement.npy"
    run_python(
        f"{WITHOUT}{SOLVE}import numpy as np\nnp.save({str(file)!r}, problem.solve().x.array)"
    )
    largest = np.abs(with_petsc.x.array).max()
    np.testing.assert_allclose(np.load(file), with_petsc.x.array, rtol=0, atol=1e-10 * largest)


@needs_rslab
def test_factors_are_by_rslab():
    printed = run_python(
        f"{WITHOUT}"
        "import numpy as np, scipy.sparse as sp\n"
        "from fenics_tfeti.feti.factors.cholesky import choose_package, sparse_cholesky\n"
        "package = choose_package('auto')\n"
        "factor = sparse_cholesky(sp.csr_matrix(np.diag([1.0, 2.0])), package)\n"
        "print(package, *factor.solve(np.array([3.0, 4.0])).round(12))\n"
    )
    assert printed == "rslab 3.0 2.0"


@needs_rslab
@needs_dolfinx
def test_command_line_is_read_without_petsc():
    code = f"{WITHOUT}{SOLVE}print(problem.options.solver.rtol, problem.options.view)"
    arguments = "-tfeti_rtol", "1e-4", "-n", "3", "-tfeti_view"
    assert run_python(code, *arguments) == "0.0001 True"


def test_missing_factor_is_told():
    printed = run_python(
        f"{WITHOUT}sys.modules['rslab'] = None\n"
        "from fenics_tfeti.errors import FactorizationError\n"
        "from fenics_tfeti.feti.factors.cholesky import choose_package\n"
        "try:\n    choose_package('auto')\n"
        "except FactorizationError as error:\n    print(error)"
    )
    assert "neither CHOLMOD nor rslab nor MUMPS" in printed and "'pip install rslab'" in printed


@needs_rslab
@needs_dolfinx
def test_self_test_passes_and_tells_what_is_missing():
    printed = run_python(f"{WITHOUT}from fenics_tfeti.__main__ import main\nsys.exit(main())")
    assert "PETSc  no petsc4py (for factors by CHOLMOD and MUMPS" in printed
    assert "sparse factors  rslab\n" in printed
    assert "passed: the pressure is exact" in printed
