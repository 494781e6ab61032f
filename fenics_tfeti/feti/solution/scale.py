"""The scale of a solve: the energy norms that the tolerances are relative to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.solution.setup import DualSetup, SolveContext
from fenics_tfeti.feti.solution.states import ContactData
from fenics_tfeti.feti.tolerances import rounding
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.typing import Mask, Vector

# Lanczos steps for an upper bound of ||PFP||, the scale of SMALBE-M
LANCZOS_STEPS = 15
# Lanczos steps for a rough value of ||PFP||: the scale of gaps against forces
ROUGH_LANCZOS_STEPS = 3


@dataclass(frozen=True)
class FeasibleState:
    """The torn displacement K^+(f - B'lambda~) at the feasible start."""

    jumps: Vector  # (m,) scaled as the rows
    strain: float  # f'K^+f of the forces f - B'lambda~ [J]
    largest_jump: float  # largest |jump|, |prescribed displacement| and penetration, over all ranks

    @staticmethod
    def of(setup: DualSetup, data: ContactData) -> FeasibleState:
        """Apply K^+ once."""
        F, comm = setup.F, setup.constraints.layout.comm
        forces = data.load - F.constraint_forces(data.feasible)
        strained = F.generalized_inverse(forces)
        jumps = F.jumps(strained)
        strain = float(comm.allreduce(max(0.0, float(strained @ forces))))
        prescribed = data.c[setup.constraints.equality]
        penetrated = -data.c[setup.constraints.inequality]
        largest = max(
            np.abs(jumps).max(initial=0.0),
            np.abs(prescribed).max(initial=0.0),
            penetrated.max(initial=0.0),
        )
        return FeasibleState(jumps, strain, largest_of_ranks(comm, largest))


@dataclass(frozen=True)
class EnergyScale:
    """Scale of the errors of displacements."""

    energy_norm: float  # an energy norm as large as the solution's, or larger [sqrt(J)]
    closing: float  # energy norm of rigid motions that close the prescribed jumps [sqrt(J)]

    @staticmethod
    def of(context: SolveContext, feasible: FeasibleState, shortened: Mask) -> EnergyScale:
        """Take the larger of the energy norms of u_t at lambda~ and of its jumps.

        Contact rows (i,) with a shortened gap are expected to stay open. Adds to the timer and the
        history of the context.
        """
        setup, data = context.setup, context.data
        jumps = _energy_of_jumps(context, shortened, feasible.jumps - data.c)
        # jumps that have to be closed, with prescribed displacements and penetrated gaps
        rows, closing = setup.constraints.inequality, data.c.copy()
        closing[rows] = np.minimum(closing[rows], 0.0)
        rigid = np.sqrt(setup.local.unit) * setup.constraints.layout.space.norm(closing)
        return EnergyScale(float(np.sqrt(max(feasible.strain, jumps))), float(rigid))

    def rounding_at(self, energy_norm: float) -> float:
        """Return the energy norm of one rounding error in jumps of displacements [sqrt(J)].

        It is the least that rounding leaves; what it leaves more shows when passes fail.
        """
        return rounding(energy_norm + self.closing)


def _energy_of_jumps(context: SolveContext, shortened: Mask, d: Vector) -> float:
    """Return r'Mr of the jumps r = B u_t - c at lambda~ that have to be closed [J].

    These are the jumps on the face of lambda~, with slips where friction is below its bound, and on
    other contact rows the penetrations. Rows with a shortened gap are expected to stay open,
    whatever lambda~ is there.
    """
    setup, data = context.setup, context.data
    layout, rows = setup.constraints.layout, setup.constraints.inequality
    pressing = (data.feasible[rows] > 0.0) & ~shortened
    springs = data.springs
    face = Face.of_multipliers(
        setup.constraints, data.feasible, data.radius, pressing, springs=springs
    )
    projector = Projector.build(setup.projector.coarse_space, face)
    r = projector.remove_rigid_motion(layout.owned_part(d), d)[0]
    r[rows] = np.where(face.rows[rows], r[rows], np.maximum(r[rows], 0.0))
    r[setup.constraints.friction.on_rows(~face.sticking, r.size)] = 0.0
    if setup.preconditioner is None:
        with context.timer.phase("norm"):
            norm = setup.norm(ROUGH_LANCZOS_STEPS)
        return layout.space.dots((r, r))[0] / (norm or 1.0)
    context.monitor.history.products.preconditioner += 1
    rows = setup.constraints.equality | (r != 0.0)
    # springs give way
    active = r[setup.constraints.inequality] > 0.0
    closed = replace(Face.of_rows(setup.constraints, rows), active=active, springs=springs)
    precondition = setup.preconditioner.on(closed)
    part = np.array([r @ precondition(r)])
    return float(layout.space.sum_over_ranks(part)[0])
