"""Messages of the iterations while they run, to the history, the log and the user's function."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from mpi4py import MPI

from fenics_tfeti.feti.dual.iterate import ActiveSetStep
from fenics_tfeti.feti.solution.states import History, SlipBoundStep, Step
from fenics_tfeti.parallel import raise_collectively

logger = logging.getLogger(__name__)

MonitorFunction = Callable[[Step], None]


@dataclass(frozen=True)
class Monitor:
    """Receivers of each step: the history, the log, standard output and the user's function."""

    history: History  # of the report
    comm: MPI.Intracomm
    function: MonitorFunction | None = None  # called with each step
    watched: bool = False  # whether any rank has a function
    prints: bool = False  # rank 0 prints a line for each step

    def tell(self, step: Step) -> None:
        """Tell of a face, an outer iteration of SMALBE-M, or a step of Coulomb's law. Collective.

        What a function raises on one rank is raised on all.
        """
        number = self.history.append(step)
        if self.comm.rank == 0:
            line = describe_step(step, number)
            logger.info(line)
            if self.prints:
                print(line, flush=True)
        if self.watched:
            with raise_collectively(self.comm):
                if self.function is not None:
                    self.function(step)


def describe_step(step: Step, number: int) -> str:
    """Return a line about a step; steps of a solve are numbered from 0.

    Examples
    --------
    >>> describe_step(ActiveSetStep(products=12, residual=3e-7, active=40, changed=2), 3)
    'face    3  products   12  residual 3.00e-07  active 40  changed 2'
    """
    if isinstance(step, ActiveSetStep):
        return (
            f"face  {number:3d}  products {step.products:4d}  residual {step.residual:.2e}  "
            f"active {step.active}  changed {step.changed}"
        )
    if isinstance(step, SlipBoundStep):
        ratio = "" if step.ratio is None else f"  ratio {step.ratio:.2f}"
        return (
            f"slip  {number:3d}  products {step.products:4d}  change {step.change:.2e}{ratio}  "
            f"rtol {step.rtol:.1e}"
        )
    return (
        f"outer {number:3d}  products {step.products:4d}  |g^P| {step.gradient:.2e}  "
        f"|Gx| {step.constraint:.2e}  M {step.M:.1e}  active {step.active}"
    )
