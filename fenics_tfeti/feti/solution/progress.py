"""The progress of the outer loop from pass to pass."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from fenics_tfeti.feti.solution.certificate import Certificate
from fenics_tfeti.feti.solution.scale import EnergyScale
from fenics_tfeti.feti.tolerances import NEGLIGIBLE

# limit on the passes of the outer loop; most solutions take one to three
_PASSES = 50
# stop after three passes and a tolerance 100 times smaller without halving the certificate
_FAILURES, _DECREASE = 3, 1e-2


class Stagnation(Enum):
    """Number that the passes have failed to reduce."""

    NONE = auto()
    OF_PASS = auto()  # the last one has halved neither number of the certificate
    OF_ROUNDING = auto()  # rounding has ended the conjugate gradients
    FINAL = auto()  # more passes with the same method do not reduce it


@dataclass
class Progress:
    """The decrease of the certificate from pass to pass.

    A pass that does not change the certificate but for rounding is no failure: it has only brought
    the tolerance down to the iterate.
    """

    scale: EnergyScale  # rounding is relative to it
    rounding: float  # smallest tolerance that the rounding of the jumps allows [sqrt(J)]
    measured: float = 0.0  # largest ratio so far of a tolerance and the bound reached with it
    bound: float = np.inf  # smallest bound of the error so far
    worst: float = np.inf  # smallest so far of the certificate's largest number
    tolerance: float = np.inf  # of the pass in which bound or worst last halved [sqrt(J)]
    failures: int = 0  # passes since then that changed the certificate
    last: tuple[float, float] = (np.inf, np.inf)  # the two numbers of the last pass
    passes: int = 0

    @staticmethod
    def start(scale: EnergyScale) -> Progress:
        """Return that before the first pass."""
        return Progress(scale, scale.rounding_at(scale.energy_norm))

    def restart(self) -> None:
        """Forget the smallest numbers: another method goes on."""
        self.bound = self.worst = self.tolerance = np.inf
        self.failures, self.passes = 0, 0

    def judge(self, certificate: Certificate, tolerance: float) -> Stagnation:
        """Compare the certificate of a pass with the smallest numbers so far."""
        self._update(certificate, tolerance)
        # without a preconditioner residuals are measured too small where the material is stiff:
        # rounding is then below that of the energy
        if 0.0 < certificate.bound < np.inf:
            self.measured = min(max(self.measured, tolerance / certificate.bound), 1.0)
        rounding = self.scale.rounding_at(certificate.energy_norm)
        self.rounding = min(self.rounding, (self.measured or 1.0) * rounding)
        failed = self.failures >= _FAILURES and tolerance <= _DECREASE * self.tolerance
        if failed or self.passes >= _PASSES or tolerance <= self.rounding:
            return Stagnation.FINAL
        return Stagnation.OF_PASS if self.failures else Stagnation.NONE

    def _update(self, certificate: Certificate, tolerance: float) -> None:
        self.passes += 1
        last, self.last = self.last, (certificate.bound, certificate.worst)
        if np.allclose(self.last, last, rtol=NEGLIGIBLE, atol=0.0):
            self.tolerance = tolerance
        else:
            self.failures += 1
        if certificate.bound <= 0.5 * self.bound or certificate.worst <= 0.5 * self.worst:
            self.bound = min(self.bound, certificate.bound)
            self.worst = min(self.worst, certificate.worst)
            self.tolerance, self.failures = tolerance, 0
