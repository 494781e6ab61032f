"""Operators on a face: projector, preconditioner and loose bodies."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.dual.loose_bodies import LooseBodies
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.typing import Operator


@dataclass(frozen=True)
class FaceOperators:
    """The operators of a face of a dual problem."""

    projector: Projector  # P and Q
    precondition: Operator | None  # x -> this rank's part of Mx
    loose: LooseBodies | None  # bodies whose position the face does not determine
    is_direct: bool = False  # whether `precondition` is a direct solver

    @staticmethod
    def build(problem: DualProblem, projector: Projector) -> FaceOperators:
        """Make those of the face of a projector. Collective."""
        face, kind = projector.face, problem.preconditioner
        loose = LooseBodies.of(projector.coarse_space, face, projector.free_bodies)
        if kind is None:
            return FaceOperators(projector, None, loose)
        if kind.is_direct:
            return FaceOperators(projector, None, loose).direct(problem)
        return FaceOperators(projector, kind.on(face), loose)

    @property
    def face(self) -> Face:
        """The face."""
        return self.projector.face

    def with_terms(self, face: Face) -> FaceOperators:
        """Return them for other terms of the cost on the same rows; the preconditioner stays."""
        return replace(self, projector=replace(self.projector, face=face))

    def direct(self, problem: DualProblem) -> FaceOperators:
        """Return them with a direct solver as the preconditioner. Collective."""
        kind = problem.preconditioner
        assert kind is not None and kind.direct is not None
        return replace(self, precondition=kind.direct.on(self.face), is_direct=True)
