"""The certificate: a guaranteed bound of the error, and how well the conditions of (11.21) hold.

For a displacement u on which all constraints hold, multipliers with lambda_I >= o and
G lambda = e, and their torn displacement u_t = K^+(f - B'lambda) + R alpha, the primal energy of u
minus the dual value of lambda is

    J(u) - D(lambda) = 1/2 ||u - u_t||_K^2 + lambda_I'(c - B_I u),

the last term zero where the contacts that press are closed. As J(u) >= J(u*) >= D(lambda), the
error of u in the energy norm is at most ||u - u_t||_K (Prager and Synge, on the discrete problem).
With friction J includes r |s| of the slips s = B_T u - c_T, and twice r |s| - lambda_T's is added
to the square of the bound: zero where nothing slips, or the slip is along a force of size r.

With springs J includes their energies phi and D the dual ones, phi* = C lambda^2 / 2, and twice the
sum of phi(v) + phi*(lambda) - lambda v is added to the square of the bound, v = B u - c: zero for
v = C lambda. The energy norms then have twice the energies of springs. The bound is that of the
solution with the given compliances; what a law makes of them is another matter.

Soft elastic supports are a part of K, with their ground as unknowns that equality rows hold
(`local.elastic_supports`): u is on y = o, u_t moves the ground a little, and the bound is the same.

Where the K_i are indefinite tangents, no theorem makes the difference of energies a bound. It is an
estimate then, with the magnitudes of the subdomains' energies in the sum.

Bodies that do not press on each other decouple: the same holds for each *group* of bodies that are
connected by closed contacts or tied. The share of a single body in ||u - u_t||_K is an estimate of
its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.feti.tolerances import NEARLY_UNLOADED


@dataclass(frozen=True)
class BodyError:
    """The error of one body.

    A body that hardly deforms is compared with a thousandth of its group's energy norm. Energy
    norms are those of u_t, which differ from those of u by the error.
    """

    body: str
    energy_norm: float  # ||u_t||_K of the body [sqrt(J)]
    error: float  # the body's share of ||u - u_t||_K, relative to the scale
    scale: float  # the body's energy norm, or the thousandth of its group's [sqrt(J)]


@dataclass(frozen=True)
class GroupError:
    """The error of a group of bodies that press on each other."""

    bodies: list[str]
    energy_norm: float  # ||u_t||_K of the group [sqrt(J)]
    error: float  # bound of ||u - u*||_K / ||u_t||_K; zero where the group's strains are rounding

    @property
    def scale(self) -> float:
        """Scale of the error: the energy norm [sqrt(J)]."""
        return self.energy_norm


@dataclass(frozen=True)
class Certificate:
    """How well displacements and multipliers solve (11.21), from K, f, B and c alone.

    All numbers are relative to scales of the body or contact concerned; all are zero for an exact
    solution. A rigid motion of any size changes none of them.

    Attributes
    ----------
    bound : float
        Bound of ||u - u*||_K, u* the exact solution with these springs [sqrt(J)].
    error : float
        The same relative to ||u_t||_K, which differs from ||u||_K by no more than the bound.
    groups : list of GroupError
        The same for each group of bodies that press on each other.
    bodies : list of BodyError
        The share of each body.
    equilibrium : float
        Largest ||Ku_t - f + B'lambda|| of a body, relative to its forces.
    penetration : float
        Largest violation of (u_slave - u_master)'n <= gap, in rows whose slave's sum has
        length 1, relative to the deformation of the bodies that touch there, or of the spring
        there; of springs that give way it is what they are closed by more than their force does.
    smallest_force : float
        Smallest contact force, relative to the largest of the same contact; negative numbers pull.
        Springs that may pull do not count.
    complementarity : float
        Largest product of force and distance, relative to the largest force of the contact and the
        deformation of its bodies. The distance of a spring is that from C lambda.
    friction_excess : float
        Largest excess of a tangential force over its bound, relative to the largest bound of the
        contact.
    slip_below_bound : float
        Largest slip where the tangential force is below its bound, beyond the elastic slip,
        relative to the deformation of the bodies that touch there, or to the elastic slip.
    slip_across_force : float
        Largest part of a slip that is not along the tangential force, relative to the same.
    guaranteed : bool
        False where the bound is an estimate: where tangents are indefinite, and with Coulomb's law,
        of which it bounds the error with the last slip bounds.
    slip_bound_error : float
        With Coulomb's law, difference between the friction forces and the bounds that the normal
        forces make, as root of the sum of squares, relative to the bounds.
    """

    bound: float
    error: float
    groups: list[GroupError]
    bodies: list[BodyError]
    equilibrium: float
    penetration: float
    smallest_force: float
    complementarity: float
    friction_excess: float = 0.0
    slip_below_bound: float = 0.0
    slip_across_force: float = 0.0
    slip_bound_error: float = 0.0
    guaranteed: bool = True

    def numbers(self) -> dict[str, float]:
        """Return what the tolerance limits, by name; of groups and bodies the largest error.

        NaN, which no tolerance limits, is infinite.
        """
        numbers = {
            "error": self.error,
            "error of a group": _largest([group.error for group in self.groups]),
            "error of a body": _largest([body.error for body in self.bodies]),
            "equilibrium": self.equilibrium,
            "penetration": self.penetration,
            "negative force": _largest([-self.smallest_force]),
            "complementarity": self.complementarity,
            "friction above its bound": self.friction_excess,
            "slip below the bound": self.slip_below_bound,
            "slip across the force": self.slip_across_force,
            "slip bound": self.slip_bound_error,
        }
        return {name: _largest([number]) for name, number in numbers.items()}

    @property
    def energy_norm(self) -> float:
        """||u_t||_K [sqrt(J)]."""
        return float(np.sqrt(sum(group.energy_norm**2 for group in self.groups)))

    @property
    def energy_error(self) -> float:
        """The largest error in the energy norm, of all, of groups and of bodies."""
        numbers = self.numbers()
        return max(numbers[name] for name in ("error", "error of a group", "error of a body"))

    @property
    def worst(self) -> float:
        """The largest of all numbers."""
        return max(self.numbers().values())

    @property
    def worst_name(self) -> str:
        """The name of the largest number."""
        numbers = self.numbers()
        return max(numbers, key=numbers.__getitem__)

    @property
    def worst_bodies(self) -> list[str]:
        """The bodies with the largest error, and those with more than half of it."""
        errors = {body.body: _largest([body.error]) for body in self.bodies}
        least = 0.5 * max(errors.values(), default=0.0)
        return [
            name for name in sorted(errors, key=errors.__getitem__)[::-1] if errors[name] > least
        ]

    def with_nearly_unloaded_bodies(self) -> Certificate:
        """Return the certificate with absolute bounds for nearly unloaded bodies and groups.

        Their errors are relative to a small part of the energy norm of all, if their own is less.
        It is what limits them where rounding ends the iterations.
        """
        least = NEARLY_UNLOADED * self.energy_norm

        def bounded(own: BodyError | GroupError) -> float:
            return own.error * min(1.0, own.scale / least) if least > 0.0 else own.error

        return replace(
            self,
            groups=[replace(group, error=bounded(group)) for group in self.groups],
            bodies=[
                replace(body, error=bounded(body), scale=max(body.scale, least))
                for body in self.bodies
            ],
        )


def _largest(numbers: Sequence[float]) -> float:
    """Return the largest number or 0, infinite if one is NaN."""
    return max([0.0, *(np.inf if np.isnan(x) else float(x) for x in numbers)])
