"""Total FETI for torn elasticity problems with contact; knows no finite element library.

A researcher with K_i, f_i and node numbers from any code fills a `TornSystem` and calls
`TornSolver`; ``numpy``, ``scipy``, ``mpi4py`` and ``petsc4py`` or ``rslab`` are all it needs.
"""

from fenics_tfeti.feti.checks.system import check_system
from fenics_tfeti.feti.dual.iterate import ActiveSetStep
from fenics_tfeti.feti.files.checkpoint import (
    SavedState,
    load_checkpoint,
    save_checkpoint,
)
from fenics_tfeti.feti.files.system import load_system, save_system
from fenics_tfeti.feti.options import Options, parse_options
from fenics_tfeti.feti.report.report import Report
from fenics_tfeti.feti.report.resultants import ContactForces, Resultant
from fenics_tfeti.feti.solution.certificate import Certificate
from fenics_tfeti.feti.solution.monitor import MonitorFunction
from fenics_tfeti.feti.solution.states import SlipBoundStep
from fenics_tfeti.feti.solver import TornSolution, TornSolver
from fenics_tfeti.feti.system import (
    ContactGuess,
    ContactRows,
    Friction,
    Prescribed,
    Subdomain,
    TornSystem,
)
from fenics_tfeti.feti.tangents import TangentKind, prepare_tangents
from fenics_tfeti.feti.timer import Timer

__all__ = [
    "ActiveSetStep",
    "Certificate",
    "ContactForces",
    "ContactGuess",
    "ContactRows",
    "Friction",
    "MonitorFunction",
    "Options",
    "Prescribed",
    "Report",
    "Resultant",
    "SavedState",
    "SlipBoundStep",
    "Subdomain",
    "TangentKind",
    "Timer",
    "TornSolution",
    "TornSolver",
    "TornSystem",
    "check_system",
    "load_checkpoint",
    "load_system",
    "parse_options",
    "prepare_tangents",
    "save_checkpoint",
    "save_system",
]
