"""The progress of the outer loop from pass to pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.feti.solution.certificate import Certificate

# limit on the passes of the outer loop; most solutions take one to three
_PASSES = 50


@dataclass
class Progress:
    """The decrease of the certificate from pass to pass.

    Attributes
    ----------
    bound, worst : float
        The smallest so far: the bound of the error, and the largest number of the certificate.
    at, tolerance : float
        Tolerances when one of them last halved, and of the last pass.
    failures : int
        Passes since then that changed the certificate: one that changes nothing has only brought
        the tolerance down to the iterate.
    last : tuple of float
        The two numbers of the last pass.
    passes : int
        All passes.
    """

    bound: float = np.inf
    worst: float = np.inf
    at: float = np.inf
    tolerance: float = np.inf
    failures: int = 0
    last: tuple[float, float] = (np.inf, np.inf)
    passes: int = 0

    def update(self, certificate: Certificate, tolerance: float) -> None:
        """Compare a certificate with the smallest numbers so far."""
        self.tolerance = tolerance
        self.passes += 1
        last, self.last = self.last, (certificate.bound, certificate.worst)
        if self.last == last:
            self.at = tolerance
        else:
            self.failures += 1
        if certificate.bound <= 0.5 * self.bound or certificate.worst <= 0.5 * self.worst:
            self.bound = min(self.bound, certificate.bound)
            self.worst = min(self.worst, certificate.worst)
            self.at, self.failures = tolerance, 0

    @property
    def stagnates(self) -> bool:
        """Whether three passes, to a hundredth of the tolerance, have halved neither of them."""
        failed = self.failures >= 3 and self.tolerance <= 1e-2 * self.at
        return failed or self.passes >= _PASSES
