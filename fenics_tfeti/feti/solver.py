"""Total FETI from the torn system to displacements, contact forces and a certificate."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
import scipy
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError, NotConverged
from fenics_tfeti.feti.coarse.body_motions import describe_body_motion
from fenics_tfeti.feti.coarse.feasible_start import check_load, feasible_start
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.rows import Constraints, build_constraints
from fenics_tfeti.feti.constraints.scaling import node_weights, stiffness_of_weight
from fenics_tfeti.feti.dual.active_set import ActiveSetStep, primal_dual_active_set
from fenics_tfeti.feti.dual.operator import DualOperator, norm_of_projected
from fenics_tfeti.feti.dual.pcpg import DualProblem, FaceSolution
from fenics_tfeti.feti.dual.preconditioner import interface_operator
from fenics_tfeti.feti.local.cholesky import choose_package
from fenics_tfeti.feti.local.congruence import CongruenceClass, find_congruence_classes
from fenics_tfeti.feti.local.generalized_inverse import GeneralizedInverse
from fenics_tfeti.feti.local.rigid_body_modes import kernel
from fenics_tfeti.feti.options import Options
from fenics_tfeti.feti.recovery import Certificate, PrimalProblem, recover_displacement
from fenics_tfeti.feti.report import Report, Timer, peak_memory
from fenics_tfeti.feti.system import ContactGuess, TornSystem
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.qp import (
    Bounds,
    MPRGPOptions,
    OuterIteration,
    Products,
    SMALBEOptions,
    SMALBEResult,
    SMALBEState,
    smalbe,
)

__all__ = ["TornSolution", "TornSolver"]

logger = logging.getLogger(__name__)

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The certificate is in other norms than the dual stopping test: while it does not hold, the test is
# tightened by what is missing and this factor, at most by the next one at once and the last in all.
_TIGHTENING = 0.5
_TIGHTENING_AT_ONCE = 0.1
_TIGHTEST = 1e-4
# what rounding leaves in the certificate of an exact solution
_ROUNDING = 1e-9
# Lanczos steps for the scale of gaps by forces, which the active set method needs roughly
_SCALE_STEPS = 3
# A guessed force closes the gap against so much of the stiffness matrix's diagonal: that of a node
# whose neighbours are held; on a surface they give way. (From 0.5 to 0.2 products hardly change.)
_SURFACE_STIFFNESS = 0.3
# relative to ||d||: what is rounding in residuals and in contact forces
_NEGLIGIBLE_LOAD = 1e-13


@dataclass(frozen=True)
class TornSolution:
    """The solution on this rank.

    Attributes
    ----------
    displacements : list of (n_i,) arrays
        u_i of this rank's subdomains [m].
    normal_force : (contact rows of this rank,) array
        Nodal normal force of each contact row that this rank gave [N].
    active : (contact rows of this rank,) bool array
        Whether the row is active.
    multipliers : (m,) array
        lambda, as far as this rank holds it.
    weights : (torn nodes of this rank,) array
        Weights of the copies of nodes.
    report : Report
        What was done.
    """

    displacements: list[Vector]
    normal_force: Vector
    active: NDArray[np.bool_]
    multipliers: Vector
    weights: Vector
    report: Report


@dataclass(frozen=True)
class _Recovered:
    """A candidate for the solution, with its certificate."""

    displacement: Vector
    multipliers: Vector
    certificate: Certificate
    active: Projector


class TornSolver:
    """Total FETI for one torn system; what does not depend on the iterations is set up at once.

    For a sequence of systems, give each solver the one before: factors are shared where the
    stiffness matrices are the same objects, the coarse problem, the norm and the preconditioner
    where the constraint rows are equal too (whatever their gaps), and the iterations start from the
    last multipliers.

    Parameters
    ----------
    system : TornSystem
        Subdomains, prescribed displacements, contact rows.
    options : Options, optional
        Tolerances and methods.
    timer : Timer, optional
        To add the times of phases to.
    previous : TornSolver, optional
        Solver of an earlier, similar system with the same options.
    guess : ContactGuess, optional
        Where to expect contact, and with what forces: the start of the active set method.

    Raises
    ------
    InputError
        Wrong or contradictory data, before any factorisation.
    UnresistedMotion
        The load pushes a body where nothing holds it, before any factorisation of a stiffness.
    FactorizationError
        A stiffness matrix is not positive semidefinite.
    """

    weights: Vector
    classes: list[CongruenceClass]
    kernels: list[Vector]
    space: CoarseSpace
    projector: Projector
    F: DualOperator
    state: SMALBEState | None
    _expected: tuple[Vector, Mask] | None
    _interface: Callable[[Vector], Vector] | None

    def __init__(
        self,
        system: TornSystem,
        options: Options | None = None,
        timer: Timer | None = None,
        previous: TornSolver | None = None,
        guess: ContactGuess | None = None,
    ) -> None:
        self.system = system
        self.options = options or Options()
        self.timer = timer or Timer()
        self.comm = system.comm
        with raise_collectively(self.comm):
            self.package = _choose_package(self.options)
            _check_guess(guess, system, self.options)
        same_K = previous if previous is not None and previous._has_stiffness_of(system) else None
        with self.timer.phase("constraints"):
            system.check(stiffness=same_K is None)
            self.weights = same_K.weights if same_K else node_weights(system, self.options.scaling)
            self.constraints: Constraints = build_constraints(system, self.weights)
            same_B = same_K if same_K and self.constraints.same_rows(same_K.constraints) else None
            if same_B:
                here = self.constraints
                self.constraints = replace(same_B.constraints, rhs=here.rhs, contact=here.contact)
        with self.timer.phase("coarse problem"):
            self.classes = same_K.classes if same_K else find_congruence_classes(system.subdomains)
            self.kernels = same_K.kernels if same_K else self._kernels()
            self.load = np.concatenate([np.zeros(0), *(s.load for s in system.subdomains)])
            self.space = same_B.space if same_B else self._coarse_space()
            self.projector = same_B.projector if same_B else Projector.build(self.space)
        with self.timer.phase("feasible start"):
            self.start = self._feasible_start()
        with self.timer.phase("factorisation"):
            inverses = same_K.F.inverses if same_K else self._inverses()
            self.F = (
                replace(same_B.F, constraints=self.constraints)
                if same_B
                else DualOperator.build(
                    self.constraints,
                    self.space.interface,
                    inverses,
                    self.options.dual_operator,
                )
            )
        self._norms: dict[int, float] = same_B._norms if same_B else {}
        with self.timer.phase("factorisation"):
            self._interface = same_B._interface if same_B else self._interface_operator()
        self.state = self._first_state(previous)
        self._expected = self._expected_contact(guess)
        self.products = Products()
        self.norm_products = 0
        self.reused = [
            *(["factors"] if same_K else []),
            *(["coarse problem", "norm"] if same_B else []),
            *(["multipliers"] if self.state is not None else []),
            *(["contact guess"] if self._expected is not None else []),
        ]

    def _has_stiffness_of(self, system: TornSystem) -> bool:
        ours, theirs = self.system.subdomains, system.subdomains
        same = len(ours) == len(theirs) and all(
            s.stiffness is t.stiffness and s.nodes is t.nodes
            for s, t in zip(ours, theirs, strict=True)
        )
        return bool(self.comm.allreduce(same, MPI.LAND))

    def _kernels(self) -> list[Vector]:
        subdomains = self.system.subdomains
        kernels = [np.zeros((0, 0))] * len(subdomains)
        for congruent in self.classes:
            shared = kernel(subdomains[congruent.first])
            for member in congruent.members:
                kernels[member] = shared
        return kernels

    def _coarse_space(self) -> CoarseSpace:
        interface = Interface.build(self.constraints.matrix, self.classes)
        return CoarseSpace.build(
            self.system,
            self.constraints,
            interface,
            self.kernels,
            self.package,
            self.options.coarse_solver,
        )

    def _feasible_start(self) -> Vector:
        e = self.space.work(self.load)
        norm = float(np.sqrt(self.comm.allreduce(float(self.load @ self.load))))
        check_load(self.system, self.kernels, self.projector, e, norm)
        return feasible_start(self.system, self.kernels, self.space, e, norm)

    def _inverses(self) -> list[GeneralizedInverse]:
        options = self.options
        with raise_collectively(self.comm):
            return [
                GeneralizedInverse(
                    self.system.subdomains[congruent.first],
                    self.kernels[congruent.first],
                    self.package,
                    options.fixing_nodes,
                )
                for congruent in self.classes
            ]

    def _stiffness(self) -> list[sp.csr_matrix]:
        return [self.system.subdomains[congruent.first].stiffness for congruent in self.classes]

    def norm(self, steps: int) -> float:
        """Estimate ||PFP|| by that many Lanczos steps, unless at least as many were taken before.

        Parameters
        ----------
        steps : int
            Products with F to spend.

        Returns
        -------
        float
            [m/N].
        """
        known = max(self._norms, default=0)
        if known < steps:
            known = steps
            with self.timer.phase("norm"):
                self._norms[steps] = norm_of_projected(
                    self.F, self.projector, steps, self.options.seed
                )
            self.norm_products += steps
        return self._norms[known]

    def _first_state(self, previous: TornSolver | None) -> SMALBEState | None:
        """Return where the last solve ended, if its multipliers are the same ones."""
        if previous is None or previous.state is None:
            return None
        if not self.constraints.same_numbering(previous.constraints):
            return None
        multipliers = previous.start + previous.state.x
        return SMALBEState(multipliers - self.start, self.projector.coarse(previous.state.q))

    def _expected_contact(self, guess: ContactGuess | None) -> tuple[Vector, Mask] | None:
        """Return the guessed multipliers of the inequality rows, and which of these are active."""
        if guess is None:
            return None
        constraints, own = self.constraints, self.constraints.own_rows
        kept = own >= 0
        force, gap = np.zeros(constraints.rhs.size), np.zeros(constraints.rhs.size)
        force[own[kept]] = np.maximum(guess.normal_force[kept], 0.0)
        # beyond any gap is far enough; infinite ones are no numbers to be summed with zeros
        gap[own[kept]] = np.minimum(guess.gap[kept], np.finfo(float).max)
        force, gap = (constraints.multipliers.sum(x)[constraints.inequality] for x in (force, gap))
        # t^2 is what the weights of the row's nodes make in series
        unit = _SURFACE_STIFFNESS * stiffness_of_weight(self.system, self.options.scaling)
        active = force / (unit * constraints.scale**2) > gap
        return np.where(active, force / constraints.scale, 0.0), active

    def solve(self) -> TornSolution:
        """Solve (11.39) by SMALBE-M over MPRGP and recover the displacement (11.29).

        Returns
        -------
        TornSolution
            Displacements, forces and the report.

        Raises
        ------
        NotConverged
            At a limit on iterations, unless the options ask for the last iterate.
        """
        with self.timer.phase("iterations"):
            # d = BK^+(f - B'lambda~) - c: that of (11.39) without a product with F
            d = self.F.load(self.load - self.F.constraint_forces(self.start))
            space = self.constraints.multipliers.space
            negligible = _NEGLIGIBLE_LOAD * space.norm(d)
            norm_b = max(space.norm(self.projector.complement(d)), negligible / self.options.rtol)
        rtol, history, faces = self.options.rtol, list[OuterIteration](), list[ActiveSetStep]()
        # from multipliers that vanish: no contact, no glue; on average cheaper than from lambda~
        state = self.state or SMALBEState(-self.start, np.zeros_like(d))
        at_rest = self._at_rest()
        if at_rest:
            state = SMALBEState(-self.start, -self.projector.coarse(d))
        promising = self.options.method == "active_set" and norm_b > 0.0 and not at_rest
        problem = self.dual_problem() if promising else None
        face: FaceSolution | None = None
        limit = max(self.options.rtol, _ROUNDING)
        while True:
            reason = ""
            if problem is not None and promising:
                state, face = self._guess_active_set(problem, face or state, rtol, norm_b, faces)
                promising = face is not None
            solved = promising
            if not solved:
                result = self._smalbe(d, state, rtol, norm_b, history)
                state, solved, reason = result.state, result.converged, result.reason
            with self.timer.phase("recovery"):
                recovered = self._recover(state, negligible)
            worst = recovered.certificate.worst
            certified = worst <= limit
            if certified or not solved or rtol <= _TIGHTEST * self.options.rtol:
                break
            rtol *= max(_TIGHTENING * limit / worst, _TIGHTENING_AT_ONCE)
        self.state = state
        if certified:
            reason = "converged"
        elif solved:
            reason = (
                f"the certificate's worst residual is {recovered.certificate.worst:.1e} although "
                "the dual problem is solved: the accuracy is at the limit of rounding"
            )
        return self._solution(recovered, certified, reason, history, faces)

    def _at_rest(self) -> bool:
        """Tell whether nothing moves: nothing pushes, is displaced or is in the way.

        Displacements of rounding size, with nothing to compare them to, would never be certified.
        """
        constraints = self.constraints
        rest = (
            not self.load.any()
            and not constraints.rhs[constraints.equality].any()
            and bool((constraints.rhs[constraints.inequality] >= 0.0).all())
        )
        return bool(self.comm.allreduce(rest, MPI.LAND))

    def _smalbe(
        self,
        d: Vector,
        state: SMALBEState,
        rtol: float,
        norm_b: float,
        history: list[OuterIteration],
    ) -> SMALBEResult:
        """Run SMALBE-M on (11.39) in units of ||PFP||; add its outer iterations to the history."""
        norm, space = self.norm(self.options.norm_steps), self.constraints.multipliers.space
        indices, before = self.constraints.inequality, len(history)
        with self.timer.phase("iterations"):
            result = smalbe(
                self.hessian(norm),
                self.projector.complement(d) / norm,
                Bounds(indices, -self.start[indices]),
                replace(state, q=state.q / norm),
                norm_b=norm_b / norm,
                options=self._smalbe_options(rtol, before),
                space=space,
                precondition=self._precondition(norm),
                products=self.products,
                monitor=lambda line: self._log(line, before),
            )
        history += result.history
        return replace(result, state=replace(result.state, q=norm * result.state.q))

    def hessian(self, norm: float) -> Callable[[Vector], tuple[Vector, Vector]]:
        """Return x -> (PFP + rho Q) x, Qx with F in units of the norm."""

        def apply(x: Vector) -> tuple[Vector, Vector]:
            part, Qx = self.projector.coarse_by_parts(x)
            y = self.projector.part_of_complement(self.F.part(x - Qx)) / norm
            both = np.column_stack([y + self.options.rho * part, part])
            product, Qx = self.constraints.multipliers.sum(both).T.copy()
            return product, Qx

        return apply

    def _precondition(self, norm: float) -> Callable[[Vector], Vector] | None:
        """Return M^{-1} = norm P B S B' P + Q / rho, to go with A = PFP / norm + rho Q."""
        interface = self._interface
        if interface is None:
            return None

        def apply(x: Vector) -> Vector:
            part, Qx = self.projector.coarse_by_parts(x)
            y = self.projector.part_of_complement(interface(x - Qx))
            return self.constraints.multipliers.sum(norm * y + part / self.options.rho)

        return apply

    def _smalbe_options(self, rtol: float, outer_so_far: int) -> SMALBEOptions:
        options = self.options
        inner = MPRGPOptions(
            Gamma=options.Gamma,
            # ||PFP + rho Q|| = max(1, rho)
            step_length=options.step_length / max(1.0, options.rho),
            expansion=options.expansion,
            max_products=options.max_products,
        )
        return SMALBEOptions(
            rtol=rtol,
            rho=options.rho,
            M0=options.M0,
            beta=options.beta,
            eta=options.eta,
            max_outer=max(1, options.max_outer - outer_so_far),
            inner=inner,
        )

    def _interface_operator(self) -> Callable[[Vector], Vector] | None:
        kind = self.options.preconditioner
        if kind == "none":
            return None
        with raise_collectively(self.comm):
            return interface_operator(kind, self.F, self._stiffness(), self.package)

    def dual_problem(self) -> DualProblem:
        """Return (11.35), to solve it in another way."""
        return DualProblem(
            self.F.part,
            self.F.load(self.load),
            self.space.work(self.load),
            self.projector,
            self.norm(_SCALE_STEPS),
            self._interface,
        )

    def _guess_active_set(
        self,
        problem: DualProblem,
        state: SMALBEState | FaceSolution,
        rtol: float,
        norm_b: float,
        steps: list[ActiveSetStep],
    ) -> tuple[SMALBEState, FaceSolution | None]:
        """Go as far as the primal-dual active set method leads; return its face if that solves."""
        start, active = self._first_face(state)

        def log(step: ActiveSetStep) -> None:
            steps.append(step)
            if self.comm.rank == 0:
                logger.info(
                    "face  %3d  products %4d  residual %.2e  active %d  changed %d",
                    len(steps) - 1,
                    *asdict(step).values(),
                )

        with self.timer.phase("iterations"):
            end = primal_dual_active_set(
                problem,
                start,
                active,
                tolerance=rtol * norm_b,
                norm_b=norm_b,
                max_products=self.options.max_products,
                products=self.products,
                monitor=log,
            )
        x = end.multipliers - self.start
        return SMALBEState(x, end.coarse_gradient), end.face if end.solved else None

    def _first_face(self, state: SMALBEState | FaceSolution) -> tuple[Vector | FaceSolution, Mask]:
        """Return where the active set method starts from."""
        if isinstance(state, FaceSolution):
            return state, state.active
        multipliers, rows = self.start + state.x, self.constraints.inequality
        if self._expected is not None:
            multipliers[rows], active = self._expected
            return multipliers, active
        # none at first: bodies then move until contact holds them
        return multipliers, multipliers[rows] > 0.0

    def _recover(self, state: SMALBEState, negligible: float) -> _Recovered:
        multipliers = self.start + state.x
        contact = self.constraints.inequality
        # lambda~ + x where both cancel: no force, and no row for the rigid motions to follow
        multipliers[contact] = np.where(
            multipliers[contact] > negligible, multipliers[contact], 0.0
        )
        displacement, active = recover_displacement(self.F, self.space, self.load, multipliers)
        certificate = self._primal_problem().certify(displacement, multipliers)
        return _Recovered(displacement, multipliers, certificate, active)

    def _primal_problem(self) -> PrimalProblem:
        return PrimalProblem(self._stiffness(), self.load, self.F)

    def _log(self, line: OuterIteration, before: int) -> None:
        if self.comm.rank == 0:
            logger.info(
                "outer %3d  products %4d  |g^P| %.2e  |Gx| %.2e  M %.1e  active %d",
                line.number + before,
                line.products,
                line.gradient,
                line.constraint,
                line.M,
                line.active,
            )

    def _solution(
        self,
        recovered: _Recovered,
        converged: bool,
        reason: str,
        history: list[OuterIteration],
        faces: list[ActiveSetStep],
    ) -> TornSolution:
        constraints, multipliers = self.constraints, recovered.multipliers
        own = constraints.own_rows
        scale = np.zeros(multipliers.size)
        scale[constraints.inequality] = constraints.scale
        decided = own < 0
        normal_force = np.where(decided, 0.0, (scale * multipliers)[own]) if own.size else scale[:0]
        ends = np.cumsum([s.size for s in self.system.subdomains])[:-1]
        solution = TornSolution(
            np.split(recovered.displacement, ends),
            normal_force,
            normal_force > 0.0,
            multipliers,
            self.weights,
            self._report(recovered, converged, reason, history, faces),
        )
        if not converged and self.options.error_if_not_converged:
            raise NotConverged(
                f"not converged to rtol {self.options.rtol:g}: {reason}. Raise the limit or rtol, "
                "or set error_if_not_converged to false to get the last iterate",
                solution,
                solution.report,
            )
        return solution

    def _report(
        self,
        recovered: _Recovered,
        converged: bool,
        reason: str,
        history: list[OuterIteration],
        faces: list[ActiveSetStep],
    ) -> Report:
        system, constraints, comm = self.system, self.constraints, self.comm
        owned = constraints.owned_inequalities
        force = constraints.scale * recovered.multipliers[constraints.inequality]
        contacts = len(system.contact_names) or int(
            comm.allreduce(int(constraints.contact.max(initial=-1)), MPI.MAX) + 1
        )
        contact_force = np.bincount(
            constraints.contact[:owned], weights=force[:owned], minlength=contacts
        )
        equality = constraints.multipliers.size - comm.allreduce(owned)
        torn = comm.allreduce(int(self.load.size))
        seconds = self.timer.seconds
        slowest = {name: comm.allreduce(time, MPI.MAX) for name, time in seconds.items()}
        return Report(
            unknowns={
                "primal": self._primal_unknowns(),
                "torn": torn,
                "dual": constraints.multipliers.size,
                "inequalities": constraints.multipliers.size - equality,
                "active": comm.allreduce(int(np.count_nonzero(force[:owned] > 0.0))),
                "coarse": self.space.size,
                "redundant": constraints.redundant,
                "dependent": constraints.dependent,
            },
            subdomains=comm.allreduce(len(system.subdomains)),
            classes=comm.allreduce(len(self.classes)),
            dual_operator=self._dual_operator(),
            outer_iterations=len(history),
            products={
                "total": self.products.total,
                "cg": self.products.cg,
                "expansion": self.products.expansion,
                "proportioning": self.products.proportioning,
                "norm": self.norm_products,
                "preconditioner": self.products.preconditioner,
            },
            reused=self.reused,
            seconds={**slowest, "total": sum(slowest.values())},
            peak_memory_bytes=peak_memory(comm),
            energy=self._primal_problem().energy(recovered.displacement),
            contact_force=comm.allreduce(contact_force).tolist(),
            free_motions=self._free_motions(recovered.active),
            certificate=recovered.certificate,
            converged=converged,
            reason=reason,
            ranks=comm.size,
            versions=_versions(),
            options=asdict(self.options),
            history=history,
            faces=faces,
        )

    def _dual_operator(self) -> dict[str, int]:
        """Count the classes by what their part of F is."""
        explicit = self.comm.allreduce(self.F.explicit)
        return {
            "implicit": self.comm.allreduce(len(self.classes)) - explicit,
            "explicit": explicit,
        }

    def _primal_unknowns(self) -> int:
        """Count the unknowns of the glued problem: each node once."""
        return self.system.gdim * self.constraints.nodes

    def _free_motions(self, active: Projector) -> list[str]:
        return [
            "; ".join(
                describe_body_motion(
                    self.system, self.kernels, self.space.own_part(motion), either_way=True
                )
            )
            for motion in active.free.T
        ]


def _check_guess(guess: ContactGuess | None, system: TornSystem, options: Options) -> None:
    if guess is None:
        return
    guess.check(system.contacts.slave.size)
    if options.method != "active_set":
        raise InputError(
            f"a guess of the contact is the start of method='active_set'; with {options.method!r} "
            "leave it out"
        )


def _choose_package(options: Options) -> str:
    if options.coarse_solver == "distributed":
        choose_package("mumps")
    return choose_package(options.factor)


def _versions() -> dict[str, str]:
    return {
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "mpi": MPI.Get_library_version().split("\n")[0].split(",")[0].strip("\x00 "),
    }
