"""What was done: sizes, iterations, residuals, times."""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mpi4py import MPI

from fenics_tfeti.feti.dual.active_set import ActiveSetStep
from fenics_tfeti.feti.pairing_table import pairing_table
from fenics_tfeti.feti.recovery import Certificate
from fenics_tfeti.qp import OuterIteration

__all__ = ["GeometryPass", "Report", "Timer", "peak_memory"]


@dataclass
class Timer:
    """Wall time by phase.

    Attributes
    ----------
    seconds : dict
        Time of each phase on this rank [s].
    """

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time of a block to a phase."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def peak_memory(comm: MPI.Intracomm) -> int:
    """Return the peak resident memory of all ranks together [bytes]."""
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(comm.allreduce(kilobytes * (1 if sys.platform == "darwin" else 1024)))


@dataclass(frozen=True)
class GeometryPass:
    """How far the surfaces of one solution, deformed, are from touching without penetration.

    Attributes
    ----------
    penetration : float
        How deep a node is in the other body at most [m].
    separation : float
        How far a node that presses is from the other body's surface at most [m].
    error : float
        The larger of both relative to the largest displacement.
    products : int
        Applications of F that the solution cost.
    """

    penetration: float
    separation: float
    error: float
    products: int


@dataclass(frozen=True)
class Report:
    """What a solve was, and how good its result is; equal on all ranks.

    Attributes
    ----------
    unknowns : dict
        Numbers of ``primal``, ``torn`` and ``dual`` unknowns, of ``inequalities``, ``active`` ones,
        of the ``coarse`` problem, of contact rows dropped as ``redundant``, and of others that
        depend linearly on the rest (``dependent``).
    reused : list of str
        What was taken over from the last solve; ``contact guess`` if one was given.
    subdomains : int
        Their number over all ranks.
    classes : int
        Classes of congruent subdomains, which share factors, summed over the ranks.
    dual_operator : dict
        How many of them have solves (``implicit``) or a dense matrix (``explicit``) for their part
        of F.
    outer_iterations : int
        Outer iterations of SMALBE-M.
    products : dict
        Applications of F by kind of step, their ``total``, those for the ``norm`` (not in the
        total), and those of the ``preconditioner``.
    seconds : dict
        Wall time by phase, the slowest rank's, and the ``total`` [s].
    peak_memory_bytes : int
        Peak resident memory, summed over the ranks.
    energy : float
        1/2 u'Ku - f'u [J].
    contact_force : list of float
        Sum of the normal forces for each contact [N].
    free_motions : list of str
        Rigid motions that the solution leaves undetermined; their smallest amount was taken.
    certificate : Certificate
        Residuals of the primal problem.
    converged : bool
        Whether the dual stopping test and the certificate hold.
    reason : str
        Why the iterations ended.
    ranks : int
        MPI ranks.
    versions : dict
        Versions of the packages used.
    options : dict
        The options of the solve.
    history : list of OuterIteration
        One entry for each outer iteration.
    faces : list of ActiveSetStep
        One entry for each face of the primal-dual active set method.
    passes : list of GeometryPass
        One entry for each solution on the way to exact non-penetration; products, seconds and
        history of the report are those of the last one.
    pairing : list of dict
        For each contact its name, the numbers of ``pairs`` and ``unmatched`` slave nodes,
        ``largest_distance`` [m] (what the tolerance limits; None for obstacles) and
        ``largest_relative_distance`` (to the size of the facets), ``largest_angle`` between the
        slave's normal and the opposite of its partner's [degrees], ``smallest_gap`` and
        ``largest_gap`` [m].
    """

    unknowns: dict[str, int]
    reused: list[str]
    subdomains: int
    classes: int
    dual_operator: dict[str, int]
    outer_iterations: int
    products: dict[str, int]
    seconds: dict[str, float]
    peak_memory_bytes: int
    energy: float
    contact_force: list[float]
    free_motions: list[str]
    certificate: Certificate
    converged: bool
    reason: str
    ranks: int
    versions: dict[str, str]
    options: dict[str, Any]
    history: list[OuterIteration]
    faces: list[ActiveSetStep]
    passes: list[GeometryPass] = field(default_factory=list)
    pairing: list[dict[str, Any]] = field(default_factory=list)

    def pairing_table(self) -> str:
        """Return `pairing` as a table to read, a line for each contact."""
        return pairing_table(self.pairing)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as nested dictionaries."""
        return asdict(self)

    def to_json(self, path: str | os.PathLike[str]) -> None:
        """Write the report as JSON; on rank 0 under MPI, and never half a file.

        Parameters
        ----------
        path : path-like
            File to write or replace.
        """
        if MPI.COMM_WORLD.rank != 0:
            return
        target = Path(path)
        with tempfile.NamedTemporaryFile(
            "w", dir=target.parent, prefix=target.name, suffix=".part", delete=False
        ) as file:
            json.dump(self.to_dict(), file, indent=2)
            file.write("\n")
        Path(file.name).chmod(0o644)
        Path(file.name).replace(target)
