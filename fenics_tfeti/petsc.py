"""PETSc where petsc4py is installed, else None.

Without it there are no factors by CHOLMOD and MUMPS, no coarse problem that ranks share, and no
options from PETSc's database; all else is the same.
"""

from __future__ import annotations

try:
    from petsc4py import PETSc
except ModuleNotFoundError as error:
    if error.name is None or error.name.split(".")[0] != "petsc4py":
        raise
    PETSc = None

__all__ = ["PETSc"]
