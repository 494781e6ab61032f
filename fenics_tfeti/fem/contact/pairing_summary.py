"""The pairing of a contact in numbers, for the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import warn_user
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING
from fenics_tfeti.typing import Mask, Vector

# share of the area with gaps smaller than the deviation of the facets, above which the user is
# told: surfaces that touch at a point or on a line have few such nodes around it
_BLURRED = 0.5


def pairing_summary(
    comm: MPI.Intracomm,
    name: str,
    discretisation: str,
    gap: Vector,
    angle: Vector,
    total: int,
    distance: Vector | None = None,
    size: Vector | float = 1.0,
    area: Vector | None = None,
    covered_area: float | None = None,
    deviation: Vector | None = None,
) -> dict[str, Any]:
    """Summarise the pairing of a contact; the same on all ranks. Collective.

    Arrays (k,) are of the conditions: gaps [m], infinite where there is no obstacle, angles between
    the slave's normals and the opposite of the master's [degrees], the distances that the tolerance
    limits and the size of the facets that they are relative to [m], areas as weights of the mean
    gap, and deviations of the facets from the curved surfaces through their nodes [m], None where
    gaps do not depend on it. `total` is the number of this rank's slave nodes, paired or not.
    """
    finite = np.isfinite(gap)
    pairs = comm.allreduce(int(finite.sum()))

    def largest(values: Vector, sign: float = 1.0) -> float | None:
        extreme = comm.allreduce(float((sign * values[finite]).max(initial=-np.inf)), MPI.MAX)
        return 0.0 + sign * extreme if pairs else None

    blurred = None
    if deviation is not None:
        # 1 where a gap is there, but smaller than the deviation
        blurred = ((gap != 0.0) & (np.abs(gap) < deviation)).astype(float)
    return {
        "contact": name,
        "discretisation": discretisation,
        "pairs": pairs,
        "unmatched": comm.allreduce(total) - pairs,
        "largest_distance": None if distance is None else largest(distance),
        "largest_relative_distance": None if distance is None else largest(distance / size),
        "largest_angle": largest(angle),
        "smallest_gap": largest(gap, -1.0),
        "largest_gap": largest(gap),
        "mean_gap": _mean(comm, gap, area, finite),
        "covered_area": None if covered_area is None else comm.allreduce(covered_area),
        "deviation": None if deviation is None else largest(deviation),
        "blurred": None if blurred is None else _mean(comm, blurred, area, finite),
    }


def warn_of_deviation(entry: Mapping[str, Any]) -> None:
    """Warn if the gaps of a contact are mostly smaller than the deviation of its facets."""
    if (entry["blurred"] or 0.0) <= _BLURRED:
        return
    mean, deviation = entry["mean_gap"], entry["deviation"]
    kind = "clearance" if mean >= 0.0 else "interference"
    warn_user(
        f"{entry['contact']}: the {kind} of the mesh, {abs(mean):.3g} in the mean, is smaller than "
        f"the deviation of the facets from the curved surfaces, up to {deviation:.3g}: gaps "
        f"between {entry['smallest_gap']:.3g} and {entry['largest_gap']:.3g} decide where the "
        "surfaces touch. Give the size that is meant, initial_gap=... (or 'touching' for none), or "
        "use cells of second order with displacement_space(mesh, degree=2), or finer facets"
    )


def _mean(comm: MPI.Intracomm, gap: Vector, area: Vector | None, finite: Mask) -> float | None:
    weights = np.ones_like(gap) if area is None else area
    total, whole = comm.allreduce(
        np.array([gap[finite] @ weights[finite], weights[finite].sum()])
    ).tolist()
    return total / whole if whole > 0.0 else None


def angles_between(first: Vector, second: Vector) -> Vector:
    """Return the angles between unit vectors (k, gdim), row by row [degrees]."""
    # by the chord, which is accurate for small angles, unlike the inverse cosine
    chord = np.linalg.norm(first - second, axis=1)
    chord[chord < COORDINATE_ROUNDING] = 0.0
    angle: Vector = np.degrees(2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
    return angle
