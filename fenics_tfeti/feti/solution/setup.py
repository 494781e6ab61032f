"""Set-up of Total FETI: the part that depends on K alone, and the part for K and B.

Both are built once and reused as long as K, or K and B, stay the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.errors import FactorizationError, InputError, UnstableTangent
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.ground import TornUnknowns
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.constraints.scaling import node_weights
from fenics_tfeti.feti.deflation.local_spectra import (
    LocalVectors,
    TornRows,
    local_vectors,
    threshold,
)
from fenics_tfeti.feti.deflation.selection import (
    subdomains_with_jumps,
    trial_eigenvalue,
    weights_of_equality_rows,
)
from fenics_tfeti.feti.deflation.space import Deflation, at_most, same_equality_rows
from fenics_tfeti.feti.deflation.stiff_modes import STIFF, StiffModes
from fenics_tfeti.feti.dual.deluxe_scaling import DeluxeScaling
from fenics_tfeti.feti.dual.direct_faces import DirectFaces
from fenics_tfeti.feti.dual.operator import DualOperator, ProjectedNorm
from fenics_tfeti.feti.dual.preconditioner import (
    Choice,
    Preconditioner,
    PreconditionerKind,
    interface_operator,
    interface_reactions,
    lumped_excess,
)
from fenics_tfeti.feti.factors.cholesky import choose_package
from fenics_tfeti.feti.factors.supernodal import Orderings
from fenics_tfeti.feti.local.congruence import (
    CongruenceClass,
    find_congruence_classes,
    of_subdomains,
)
from fenics_tfeti.feti.local.elastic_supports import set_free
from fenics_tfeti.feti.local.generalized_inverse import GeneralizedInverse
from fenics_tfeti.feti.local.symmetry import SymmetryGroup, find_symmetries
from fenics_tfeti.feti.local.trial_displacements import TrialDisplacements
from fenics_tfeti.feti.options import Options
from fenics_tfeti.feti.solution.monitor import Monitor
from fenics_tfeti.feti.solution.row_bodies import RowBodies
from fenics_tfeti.feti.solution.states import ContactData
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.parallel import any_rank, raise_collectively
from fenics_tfeti.typing import Operator, Vector

# factors of the threshold of deflated eigenvalues, tried until U'FU has all negative ones
_LIMITS = (1.0, 0.01)


@dataclass(frozen=True)
class LocalSetup:
    """Set-up that depends on the stiffness matrices alone."""

    weights: Vector  # (torn nodes of this rank,) D in B D^{-1} B' = blockdiag(I, W)
    unknowns: TornUnknowns  # displacements, and the ground of soft elastic supports
    classes: list[CongruenceClass]
    kernels: list[Vector]  # (n_i, k_i) R_i of each subdomain in its frame; congruent ones share it
    stiffness: list[sp.csr_matrix]  # (n_i, n_i) K_i of each class in its frame [N/m]
    unit: float  # the stiffness that a weight of 1 stands for [N/m]
    ratios: list[float]  # bulk over shear modulus of each class

    @staticmethod
    def build(system: TornSystem, options: Options) -> LocalSetup:
        """Weigh the copies of nodes, find congruent subdomains and their rigid body modes."""
        subdomains = system.subdomains
        weights = node_weights(system, options.scaling)
        classes = find_congruence_classes(subdomains)
        floating = [set_free(subdomains[congruent.first]) for congruent in classes]
        kernels = [np.zeros((0, 0))] * len(subdomains)
        grounds = np.zeros(len(subdomains), dtype=np.int64)
        for congruent, free in zip(classes, floating, strict=True):
            grounds[congruent.members] = free.grounds
            for member in congruent.members:
                kernels[member] = free.kernel
        sizes = np.array([s.size for s in subdomains], dtype=np.int64)
        unknowns = TornUnknowns(sizes, grounds)
        if grounds.any():
            ends = unknowns.ends
            classes = [
                replace(c, starts=ends[c.members], size=f.kernel.shape[0])
                for c, f in zip(classes, floating, strict=True)
            ]
        stiffness = [free.stiffness for free in floating]
        ratios = [weights.bulk_over_shear[congruent.first] for congruent in classes]
        return LocalSetup(
            weights.values, unknowns, classes, kernels, stiffness, weights.unit, ratios
        )

    def jumps(self) -> Vector:
        """Return the largest ratio of diagonal entries of K_i of each class, 1 of rigid bodies."""
        diagonals = (K.diagonal() for K in self.stiffness)
        return np.array([d.max() / d.min() if d.all() else 1.0 for d in diagonals])

    def on_interface(self, interface: Interface) -> list[Vector]:
        """Return R_i (b, k) on the interface unknowns of each class."""
        return [
            self.kernels[congruent.first][unknowns]
            for congruent, unknowns in zip(self.classes, interface.unknowns, strict=True)
        ]


def factor_subdomains(
    system: TornSystem,
    options: Options,
    local: LocalSetup,
    package: str,
    orderings: Orderings | None = None,
) -> list[GeneralizedInverse]:
    """Factor the regularised stiffness matrix of each class: K_i^+ (11.28). Collective.

    It has the symmetries of K_i where a dense matrix could be made of it. `FactorizationError` is
    raised on all ranks if a stiffness matrix is not positive semidefinite.
    """
    with raise_collectively(system.comm):
        return [
            GeneralizedInverse(
                system.subdomains[congruent.first],
                local.kernels[congruent.first],
                package,
                stiffness=K,
                symmetries=_symmetries(system, options, congruent, K),
                orderings=orderings,
            )
            for congruent, K in zip(local.classes, local.stiffness, strict=True)
        ]


def _symmetries(
    system: TornSystem, options: Options, congruent: CongruenceClass, K: sp.csr_matrix
) -> SymmetryGroup | None:
    dense = options.dual_operator == "explicit"
    if dense or (options.dual_operator == "auto" and congruent.members.size > 1):
        return find_symmetries(K, system.subdomains[congruent.first].coordinates_in_frame)
    return None


@dataclass(frozen=True)
class DualSetup:
    """Set-up that depends on the stiffness matrices and the rows of B."""

    local: LocalSetup
    constraints: Constraints  # B
    projector: Projector  # P and Q of all rows
    F: DualOperator  # BK^+B'
    preconditioner: Preconditioner | None  # B_D S B_D' on faces
    choice: Choice  # of the preconditioner
    norm: ProjectedNorm  # ||PFP||
    row_bodies: RowBodies
    # (subdomains,) of F_s that trial displacements show, in the order of the packed interface
    # unknowns; empty where nothing is chosen by them
    eigenvalues: Vector
    negative: int  # negative eigenvalues of the K_i of all ranks
    deflation: Deflation | None = None  # what F and d are replaced by, if anything
    deflation_solves: int = 0  # solves with K_i^+ of this rank for deflation or its vectors

    @staticmethod
    def build(
        system: TornSystem,
        options: Options,
        local: LocalSetup,
        projector: Projector,
        inverses: Sequence[GeneralizedInverse],
        package: str,
    ) -> DualSetup:
        """Make F and the preconditioner. Collective."""
        coarse_space = projector.coarse_space
        F = DualOperator.build(
            coarse_space.constraints, coarse_space.interface, inverses, options.dual_operator
        )
        constraints = coarse_space.constraints
        negative = sum(of_subdomains(local.classes, [i.negative for i in inverses]))
        of_all = system.comm.allreduce(negative)
        choice, reactions, eigenvalues = _chosen_reactions(
            system, options, local, F, package, of_all
        )
        preconditioner = scaling = None
        if choice.kind == "dirichlet" and not options.is_plain:
            modes = _stiff_modes(system, local, F, reactions)
            scaling = DeluxeScaling.build(F, modes, local.unit, package)
            if scaling is not None:
                choice = choice.with_stiff_modes(scaling.size)
        if choice.kind != "none":
            apply = interface_operator(F, reactions, scaling)
            direct = None
            if not of_all and not options.is_plain:
                direct = DirectFaces.build(F, local.stiffness, local.unit, package)
            preconditioner = Preconditioner(apply, constraints, local.unit, scaling, direct)
        return DualSetup(
            local,
            constraints,
            projector,
            F,
            preconditioner,
            choice,
            ProjectedNorm(F.part, projector, 1.0 / local.unit),
            RowBodies.build(system, constraints, local.unknowns.ends),
            eigenvalues,
            of_all,
        )

    def deflated(
        self, system: TornSystem, options: Options, known: DualSetup | None = None
    ) -> DualSetup:
        """Return the set-up with deflation, if options, material or tangents ask for it.

        `known` has the same stiffness matrices: its vectors serve again if the equality rows are
        the same, too. Raises `UnstableTangent` on all ranks if the inertia of the K_i shows that
        the glued tangent is not positive. Collective.
        """
        if options.is_plain:
            if self.negative:
                raise InputError(
                    f"option 'deflation' is 'off', but the stiffness matrices have {self.negative} "
                    "negative eigenvalues, which only deflation can remove. Leave it at 'auto'"
                )
            return self
        for factor in _LIMITS:
            deflated = self._deflated(system, options, known, factor)
            found = 0 if deflated.deflation is None else deflated.deflation.negative
            if found >= self.negative:
                return deflated
        raise UnstableTangent(
            f"the tangents of the subdomains have {self.negative} negative eigenvalues, of which "
            f"the equality constraints remove {found}: the glued tangent is not positive, as "
            "beyond a buckling load, or where only contact holds a body. Take those of "
            "prepare_tangents(system, 'projected'), or a smaller load step"
        )

    def _deflated(
        self, system: TornSystem, options: Options, known: DualSetup | None, factor: float
    ) -> DualSetup:
        if known is not None and same_equality_rows(self.constraints, known.constraints):
            solves, vectors = 0, None if known.deflation is None else known.deflation.vectors
        else:
            vectors = self._vectors(system, options, factor)
            solves = 0 if vectors is None else vectors.solves
        if vectors is None:
            return self
        coarse_space = self.projector.coarse_space
        deflation = Deflation.build(coarse_space, self.F.on_interface, vectors)
        if deflation is None:
            return replace(self, deflation_solves=solves)
        norm = self._norm_of(partial(deflation.part, self.F.packed))
        solves += deflation.solves
        return replace(self, norm=norm, deflation=deflation, deflation_solves=solves)

    def for_solve(self, is_direct: bool = False) -> DualSetup:
        """Return the set-up of one solve, which may go over to direct solvers of faces."""
        if self.preconditioner is None:
            return self
        return replace(self, preconditioner=self.preconditioner.for_solve(is_direct))

    @property
    def is_direct(self) -> bool:
        """Whether faces are solved directly."""
        return self.preconditioner is not None and self.preconditioner.is_direct

    def without_deflation(self) -> DualSetup:
        """Return the set-up with F itself; its norm is estimated anew."""
        if self.deflation is None:
            return self
        return replace(self, norm=self._norm_of(self.F.part), deflation=None)

    def _norm_of(self, part: Callable[[Vector], Vector]) -> ProjectedNorm:
        return ProjectedNorm(part, self.projector, 1.0 / self.local.unit)

    def _vectors(self, system: TornSystem, options: Options, factor: float) -> LocalVectors | None:
        """Return the vectors of this rank's subdomains; None if no rank has any to look for.

        They are those with eigenvalues above the threshold times a factor.
        """
        interface, local = self.F.interface, self.local
        order = [member for congruent in local.classes for member in congruent.members]
        chosen = np.ones(len(order), dtype=bool)
        nodes = [system.subdomains[member].nodes.size for member in order]
        limits = np.array([threshold(system.gdim, n) for n in nodes])
        if options.deflation == "auto":
            # rotations that the stress hardly resists make F large, too
            chosen = np.array([system.subdomains[i].is_tangent for i in order], dtype=bool)
            # with weights of 1, F measures every stiffness
            if options.scaling == "stiffness":
                chosen |= subdomains_with_jumps(system, self.constraints, interface, local.unknowns)
                # F is large in the directions of soft supports: F_c would lose as many digits
                if not any_rank(system.comm, local.unknowns.grounds):
                    chosen |= self.eigenvalues > limits
            if not any_rank(system.comm, chosen):
                return None
        vectors = local_vectors(
            TornRows.build(interface, self.constraints.equality, chosen),
            interface,
            self.F.on_interface,
            local.on_interface(interface),
            numbers=self.constraints.layout.numbers,
            unit=local.unit,
            limits=factor * limits,
            negative=of_subdomains(local.classes, [i.negative for i in self.F.inverses]),
        )
        return at_most(system.comm, vectors)

    def part(self, x: Vector) -> Vector:
        """Return this rank's part of Fx, or of F_c x."""
        if self.deflation is None:
            return self.F.part(x)
        return self.deflation.part(self.F.packed, x)

    def reduced(self, d: Vector) -> Vector:
        """Return d, or d_c. Collective."""
        return d if self.deflation is None else self.deflation.reduced(d)

    def load(self, data: ContactData) -> Vector:
        """Return d, or d_c, by one application of K^+. Collective."""
        return self.reduced(self.F.load(data.load, data.c))


@contextmanager
def _unstable_if(negative: int) -> Iterator[None]:
    """Turn the failure to factor a K_i with its interface held into an `UnstableTangent`."""
    try:
        yield
    except FactorizationError as error:
        if not negative:
            raise
        raise UnstableTangent(
            "the tangent of a subdomain is not positive even where its interface is held, so "
            "neither is that of the glued bodies. Take those of prepare_tangents(system, "
            "'projected'), or a smaller load step"
        ) from error


def _by_trial_displacements(
    system: TornSystem,
    options: Options,
    local: LocalSetup,
    F: DualOperator,
    lumped: Sequence[Operator],
) -> tuple[list[float], Vector]:
    """Return `lumped_excess` of each class, and the largest eigenvalue of each subdomain.

    A class at a time: its trial displacements are a dozen vectors. Empty where "auto" is not asked.
    """
    if "auto" not in (options.preconditioner, options.deflation):
        return [], np.zeros(0)
    excesses, eigenvalues, interface = list[float](), [np.zeros(0)], F.interface
    weights = interface.blocks(weights_of_equality_rows(F.constraints, interface, local.unit))
    for i, (congruent, unknowns) in enumerate(
        zip(interface.classes, interface.unknowns, strict=True)
    ):
        first = system.subdomains[congruent.first]
        trial = TrialDisplacements.build(local.stiffness[i], first.coordinates_in_frame, unknowns)
        if options.preconditioner == "auto":
            edge = first.nodes.size ** (1.0 / system.gdim)
            excesses.append(lumped_excess(lumped[i], trial, edge))
        R = local.kernels[congruent.first][unknowns]
        largest = trial_eigenvalue(trial, weights[i], R)
        eigenvalues.append(np.full(congruent.members.size, largest))
    return excesses, np.concatenate(eigenvalues)


def _reactions(
    kind: PreconditionerKind, local: LocalSetup, F: DualOperator, package: str
) -> list[Operator]:
    """Return S of each class for a preconditioner."""
    kernels = [local.kernels[congruent.first] for congruent in local.classes]
    return interface_reactions(kind, F.interface.unknowns, local.stiffness, kernels, package)


def _chosen_reactions(
    system: TornSystem,
    options: Options,
    local: LocalSetup,
    F: DualOperator,
    package: str,
    negative: int,
) -> tuple[Choice, list[Operator], Vector]:
    """Return the preconditioner of the options, or of "auto", and S of each class. Collective.

    With them the eigenvalues that trial displacements show, see `_by_trial_displacements`.
    `negative` is the number of negative eigenvalues of the K_i of all ranks.
    """
    choice, lumped = Choice(options.preconditioner), list[Operator]()
    if choice.kind in ("auto", "lumped"):
        lumped = _reactions("lumped", local, F, package)
    excesses, eigenvalues = _by_trial_displacements(system, options, local, F, lumped)
    if choice.kind == "auto":
        # an indefinite interior has no Dirichlet preconditioner
        choice = Choice.by_data(system.comm, local.ratios, [] if negative else excesses)
    if choice.kind != "dirichlet":
        return choice, lumped, eigenvalues
    with raise_collectively(system.comm), _unstable_if(negative):
        return choice, _reactions("dirichlet", local, F, package), eigenvalues


def _stiff_modes(
    system: TornSystem, local: LocalSetup, F: DualOperator, reactions: Sequence[Operator]
) -> list[StiffModes | None]:
    """Return the stiff modes of each class; None where the material is not that incompressible."""
    interface, modes, end = F.interface, list[StiffModes | None](), 0
    for congruent, unknowns, reaction, ratio in zip(
        interface.classes, interface.unknowns, reactions, local.ratios, strict=True
    ):
        begin, end = end, end + unknowns.size * congruent.members.size
        # theta is less than the ratio
        stiff = None
        if ratio > STIFF and unknowns.size:
            columns = interface.columns[begin : begin + unknowns.size]
            x = system.subdomains[congruent.first].coordinates_in_frame
            dilatation = np.zeros(congruent.size)
            dilatation[: x.size] = (x - x.mean(axis=0)).ravel()
            weights = local.unit * F.constraints.weights[columns]
            stiff = StiffModes.build(reaction, weights, dilatation[unknowns])
        modes.append(stiff if stiff is not None and stiff.values.size else None)
    return modes


@dataclass(frozen=True)
class SolveContext:
    """Operators, data and options of one solve, with the timer and the monitor to add to."""

    setup: DualSetup
    data: ContactData
    options: Options
    timer: Timer
    monitor: Monitor
    body_names: Sequence[str] = ()


def choose_factor(options: Options) -> str:
    """Return the package of the sparse Cholesky factors.

    `FactorizationError` is raised if it is not available, or if MUMPS is needed for the coarse
    problem and missing.
    """
    if options.coarse_solver == "distributed":
        choose_package("mumps")
    return choose_package(options.factor)
