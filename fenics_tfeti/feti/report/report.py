"""The report of a solve: sizes, iterations, residuals, times."""

from __future__ import annotations

import json
import os
import resource
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy
import scipy.sparse as sp

from fenics_tfeti.errors import first_few, format_point, without_places
from fenics_tfeti.feti.coarse.body_motions import describe_body_motions
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.dual.iterate import ActiveSetStep
from fenics_tfeti.feti.factors.cholesky import describe_package
from fenics_tfeti.feti.files.arrays import write_whole
from fenics_tfeti.feti.report.resultants import ContactForces, Resultant, resultants
from fenics_tfeti.feti.solution.certificate import Certificate
from fenics_tfeti.feti.solution.setup import DualSetup, SolveContext, choose_factor
from fenics_tfeti.feti.solution.states import (
    Candidate,
    ContactData,
    Outcome,
    SlipBoundStep,
)
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import FACETED, NEGLIGIBLE
from fenics_tfeti.parallel import count_over_ranks, meet, raise_collectively
from fenics_tfeti.petsc import PETSc
from fenics_tfeti.qp import OuterIteration

FEW_LINES = 12  # for the contacts in a printed report


def peak_memory(comm: MPI.Intracomm) -> int:
    """Return the peak resident memory of all ranks together [bytes]."""
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(comm.allreduce(kilobytes * (1 if sys.platform == "darwin" else 1024)))


@dataclass(frozen=True)
class Report:
    """Sizes, iterations, accuracy and times of a solve; equal on all ranks.

    Attributes
    ----------
    unknowns : dict
        Numbers of ``primal``, ``torn`` and ``dual`` unknowns, of ``inequalities``, ``active`` ones,
        of ``tied`` rows, of the ``coarse`` problem, of contact and tied rows dropped as
        ``redundant``, of others that depend linearly on the rest (``dependent``), and of those
        dropped for their ``infinite_gaps``; of contact rows with ``friction`` and those among them
        that are ``sticking``, below their slip bound.
    reused : list of str
        What was reused from the last solve; ``contact guess`` if one was given.
    subdomains : int
        Their number over all ranks.
    classes : int
        Classes of congruent subdomains, which share factors, summed over the ranks.
    factor : str
        Package of the sparse factors; of CHOLMOD with what they are applied by, on rank 0.
    dual_operator : dict
        How many of them have solves (``implicit``) or a dense matrix (``explicit``) for their part
        of F.
    preconditioner : str
        The one of the option, or what "auto" has chosen.
    preconditioner_reason : str
        Why, if "auto" has not chosen the lumped one.
    outer_iterations : int
        Outer iterations of SMALBE-M.
    products : dict
        Applications of F by kind of step, their ``total``, those for the ``norm`` and for the
        set-up of ``deflation`` (not in the total; the latter are solves with K_i^+ for each
        subdomain, many at once), and those of the ``preconditioner``.
    deflation : dict
        Deflated directions of the dual operator (``vectors``), and their memory over all ranks
        (``bytes``); negative eigenvalues of the stiffness matrices (``negative``), which are among
        them.
    seconds : dict
        Wall time by phase, the slowest rank's, and the ``total`` [s].
    peak_memory_bytes : int
        Peak resident memory, summed over the ranks.
    energy : float
        1/2 u'Ku - f'u, with friction and the work of the slip bounds on the slips [J].
    contacts : list of ContactForces
        Forces, moments and the work of friction for each contact and tied pair.
    load : Resultant
        Force and moment of the load.
    reactions : list of Resultant
        For each Dirichlet condition the force and moment that the support exerts. Of several
        conditions for one displacement the last one counts.
    springs : Resultant
        Force and moment that elastic supports in the bilinear form exert; in axisymmetric forms
        the radial force of the hoop stress too, of exact tangents the moment of stresses that
        rotate.
    equilibrium : float
        The sum of the forces of load, supports, springs and obstacles, relative to the largest sum
        of magnitudes of nodal forces among them.
    free_motions : list of str
        Rigid motions that the solution leaves undetermined; their smallest amount was taken.
    weak_motions : list of str
        Rigid motions that only a tilt of contact normals resists, with the contacts: how far bodies
        have moved that way is known hardly better than for free motions.
    certificate : Certificate
        Residuals of the primal problem.
    dual_tolerance : float
        Tolerance of the dual problem that the certificate took: an energy norm [sqrt(J)].
    converged : bool
        Whether every number of the certificate is at most rtol, or 1e-9 if that is larger. Where
        rounding ends the iterations, the errors of nearly unloaded bodies are relative to a
        millionth of the energy norm of all, also in the certificate.
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
    slip_bounds : list of SlipBoundStep
        One entry for each step of the fixed point on the slip bounds of Coulomb's law.
    comm : MPI.Intracomm
        The ranks of the problem, of which rank 0 writes files.
    """

    unknowns: dict[str, int]
    reused: list[str]
    subdomains: int
    classes: int
    factor: str
    dual_operator: dict[str, int]
    preconditioner: str
    preconditioner_reason: str
    outer_iterations: int
    products: dict[str, int]
    deflation: dict[str, int]
    seconds: dict[str, float]
    peak_memory_bytes: int
    energy: float
    contacts: Sequence[ContactForces]
    load: Resultant
    reactions: list[Resultant]
    springs: Resultant
    equilibrium: float
    free_motions: list[str]
    weak_motions: list[str]
    certificate: Certificate
    dual_tolerance: float
    converged: bool
    reason: str
    ranks: int
    versions: dict[str, str]
    options: dict[str, Any]
    history: list[OuterIteration]
    faces: list[ActiveSetStep]
    slip_bounds: list[SlipBoundStep]
    comm: MPI.Intracomm | None = field(
        default_factory=lambda: MPI.COMM_SELF, repr=False, compare=False
    )

    def to_dict(self) -> dict[str, Any]:
        """Return the report as nested dictionaries."""
        # a communicator cannot be copied
        whole = asdict(replace(self, comm=None))
        del whole["comm"]
        return whole

    def __str__(self) -> str:
        """Return the main figures as lines to read: the result, forces, motions, the solver."""
        forces = [f"{format_point(c.force)} of {c.name!r}" for c in self.contacts]
        lines = {"force on slave": first_few(forces, FEW_LINES, "contacts")}
        return as_lines([*self.result_lines(), *unfolded(lines), *self.solver_lines()])

    def result_lines(self) -> list[tuple[str, str]]:
        """Return how the solve has ended, each line with its title."""
        accuracy = "at most" if self.certificate.guaranteed else "estimated as"
        error = f"{self.certificate.energy_error:.1e}"
        bound = f"{accuracy} {error} in the energy norm, without that of the mesh"
        return [("result", self.reason), ("error", bound)]

    def solver_lines(self) -> list[tuple[str, str]]:
        """Return motions that are not held, and how it was solved, each line with its title."""
        unknowns, products = self.unknowns, self.products
        negative = f", {n} of them negative" if (n := self.deflation["negative"]) else ""
        because = f", for {why}" if (why := self.preconditioner_reason) else ""
        lines = {
            "unknowns": f"{unknowns['primal']}, in {self.subdomains} subdomains",
            "contact": f"{unknowns['active']} of {unknowns['inequalities']} conditions active",
            "friction": f"{unknowns['sticking']} of {unknowns['friction']} nodes stick",
            "iterations": f"{products['total']} products with the dual operator, and "
            f"{products['norm']} for its norm",
            "preconditioner": self.preconditioner + because,
            "deflation": f"{self.deflation['vectors']} directions{negative}",
            "time": f"{self.seconds['total']:.2f} s ({self._slowest()}), MPI ranks: {self.ranks}",
        }
        has = {"friction": unknowns["friction"], "deflation": self.deflation["vectors"]}
        motions = {
            "free motion": first_few(self.free_motions, 6, "free motions"),
            "weak motion": first_few(self.weak_motions, 6, "weak motions"),
        }
        rows = [(name, without_places(line)) for name, line in unfolded(motions)]
        return rows + [(name, line) for name, line in lines.items() if has.get(name, True)]

    def _slowest(self) -> str:
        """Return the two phases that took longest."""
        phases = {name: time for name, time in self.seconds.items() if name != "total"}
        longest = sorted(phases, key=lambda name: -phases[name])[:2]
        return ", ".join(f"{name} {phases[name]:.2f}" for name in longest)

    def to_json(self, path: str | os.PathLike[str]) -> None:
        """Write the report as JSON, and never half a file. Collective; rank 0 of `comm` writes.

        Infinite numbers and NaN, which JSON does not have, are written as null.

        Parameters
        ----------
        path : path-like
            File to write or replace.

        Raises
        ------
        OSError
            On all ranks, if rank 0 cannot write the file.
        """
        if self.comm is None:
            self._write(path)
            return
        meet(self.comm, "to_json()")
        with raise_collectively(self.comm):
            if self.comm.rank == 0:
                self._write(path)

    def _write(self, path: str | os.PathLike[str]) -> None:
        text = json.dumps(without_nan(self.to_dict()), indent=2, allow_nan=False)
        write_whole(path, "the report", lambda file: file.write(f"{text}\n".encode()))


def without_nan(value: Any) -> Any:
    """Replace infinite numbers and NaN in nested containers by None."""
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(entry) for entry in value]
    return value


def unfolded(lists: Mapping[str, Sequence[str]]) -> list[tuple[str, str]]:
    """Return a line for each text in lists with a title."""
    return [(name, line) for name, some in lists.items() for line in some]


def as_lines(rows: Sequence[tuple[str, str]]) -> str:
    """Return lines to read of at most 90 characters, each with its title."""
    lines = []
    for name, value in rows:
        wrapped = textwrap.wrap(value, 72, break_long_words=False, break_on_hyphens=False)
        titles = [name, *[""] * (len(wrapped) - 1)]
        lines += [f"{title:>16}  {line}" for title, line in zip(titles, wrapped, strict=True)]
    return "\n".join(lines)


def build_report(
    system: TornSystem, context: SolveContext, outcome: Outcome, reused: list[str]
) -> Report:
    """Gather the figures of a solve from all ranks. Collective."""
    setup, data, history = context.setup, context.data, context.monitor.history
    comm, candidate, local = system.comm, outcome.candidate, setup.local
    explicit, classes = comm.allreduce(setup.F.explicit), comm.allreduce(len(local.classes))
    subdomains = comm.allreduce(len(system.subdomains))
    products = history.products
    slips, springs = candidate.slips, data.springs
    if springs is not None:
        forces = setup.constraints.friction.at_sites(candidate.multipliers)
        plastic = springs.plastic(slips, forces)
        slips = np.where(candidate.recovered.face.sticking[:, None], 0.0, plastic)
    multipliers, energy = data.without_adhesion(candidate.multipliers), candidate.energy
    adhesion = data.adhesion
    if adhesion is not None:
        # of the given load, and of the gaps that adhesion has opened
        energy += setup.constraints.layout.space.dots((adhesion, data.c))[0]
        data = replace(data, load=data.load - setup.F.constraint_forces(adhesion))
    sums = resultants(system, setup.F, local, data, multipliers, slips)
    return Report(
        unknowns=_unknowns(system, setup, data, candidate),
        reused=reused,
        subdomains=subdomains,
        classes=classes,
        factor=comm.bcast(describe_package(choose_factor(context.options))),
        dual_operator={"implicit": classes - explicit, "explicit": explicit},
        preconditioner=setup.choice.kind,
        preconditioner_reason=setup.choice.reason,
        outer_iterations=len(history.outer),
        products={
            "total": products.total,
            "cg": products.cg,
            "expansion": products.expansion,
            "proportioning": products.proportioning,
            "norm": setup.norm.products - history.norm_products_before,
            "deflation": -(-comm.allreduce(history.deflation_solves) // subdomains),
            "preconditioner": products.preconditioner,
        },
        deflation={
            "vectors": 0 if setup.deflation is None else setup.deflation.size,
            "bytes": comm.allreduce(0 if setup.deflation is None else setup.deflation.bytes),
            "negative": setup.negative,
        },
        seconds=context.timer.slowest(comm),
        peak_memory_bytes=peak_memory(comm),
        energy=energy,
        **vars(sums),
        free_motions=_described(system, setup, candidate.projector.free),
        weak_motions=_weak_motions(system, setup, candidate),
        certificate=candidate.certificate,
        dual_tolerance=outcome.tolerance,
        converged=outcome.converged,
        reason=outcome.reason,
        ranks=comm.size,
        versions=versions(),
        options=asdict(context.options),
        history=history.outer,
        faces=history.faces,
        slip_bounds=history.slip_bounds,
        comm=comm,
    )


def _unknowns(
    system: TornSystem, setup: DualSetup, data: ContactData, candidate: Candidate
) -> dict[str, int]:
    """Count the unknowns and rows over all ranks; see `Report`. Collective."""
    constraints, comm = setup.constraints, system.comm
    owned, sites = constraints.owned_inequalities, constraints.owned_sites
    force = constraints.rows.of(Kind.CONTACT).scale * candidate.multipliers[constraints.inequality]
    counts = {
        "torn": data.load.size,
        "inequalities": owned,
        "active": np.count_nonzero(force[:owned] > 0.0),
        "tied": constraints.owned_tied,
        "friction": np.count_nonzero(sites),
        "sticking": np.count_nonzero(sites & candidate.recovered.face.sticking),
    }
    totals = comm.allreduce(np.array(list(counts.values()), dtype=np.int64))
    return {
        "primal": system.gdim * constraints.nodes,
        "dual": constraints.layout.size,
        "coarse": setup.projector.coarse_space.size,
        "redundant": constraints.redundant,
        "dependent": constraints.dependent,
        "infinite_gaps": constraints.infinite_gaps,
        **dict(zip(counts, totals.tolist(), strict=True)),
    }


def _described(
    system: TornSystem,
    setup: DualSetup,
    motions: sp.csr_matrix,
    negligible: float = NEGLIGIBLE,
) -> list[str]:
    """Name the bodies that take part in each of some motions (coarse, k). Collective."""
    own = sp.csr_matrix(setup.projector.coarse_space.own_part(motions).T)
    return describe_body_motions(system, setup.local.kernels, own, True, negligible)


def _weak_motions(system: TornSystem, setup: DualSetup, candidate: Candidate) -> list[str]:
    """Describe the motions that active rows resist weakly, and by which contacts. Collective."""
    constraints, coarse_space = setup.constraints, setup.projector.coarse_space
    rows = candidate.projector.face.rows
    resistance = coarse_space.resistance(Face.of_rows(constraints, rows), FACETED)
    owned = constraints.owned_contact_rows
    contact = constraints.rows.of(Kind.CONTACT).contact[: owned.size]
    active = rows[owned]
    number = count_over_ranks(coarse_space.comm, contact)
    descriptions = []
    for z in resistance.resisted.T.tocsr():
        motion = z.toarray().ravel()
        closing = (coarse_space.bodies.moved[owned[active]] @ motion) ** 2
        squares = np.bincount(contact[active], closing, number)
        resistance = np.sqrt(coarse_space.comm.allreduce(squares))
        # what is not the contacts' is that of supports or friction
        if not resistance.any():
            continue
        coarse_motion = sp.csr_matrix(coarse_space.coarse_motions(motion)[:, None])
        (words,) = _described(system, setup, coarse_motion, FACETED)
        names = [
            f"{system.contact_name(int(i))!r} by {resistance[i]:.0e}"
            for i in np.argsort(-resistance)
            if resistance[i] > 0.1 * resistance.max()
        ]
        descriptions.append(
            f"{words}; resisted by tilted normals only, which close {', '.join(names)} of it"
        )
    return descriptions


def versions() -> dict[str, str]:
    """Return the versions of NumPy, SciPy, MPI, and PETSc if there is one."""
    return {
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        **({"petsc": ".".join(map(str, PETSc.Sys.getVersion()))} if PETSc else {}),
        "mpi": MPI.Get_library_version().split("\n")[0].split(",")[0].strip("\x00 "),
    }
