"""How a contact was matched, in numbers, for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import warn_user
from fenics_tfeti.parallel import largest_of_groups
from fenics_tfeti.typing import Array, Numbers, Vector

_ENTRIES = (
    *("contact", "discretisation", "pairs", "unmatched", "largest_distance"),
    *("largest_relative_distance", "largest_angle", "smallest_gap", "largest_gap", "mean_gap"),
    *("covered_area", "deviation", "blurred"),
)


def matching_summaries(
    comm: MPI.Intracomm,
    names: Sequence[str],
    discretisation: str,
    contact: Numbers,
    gap: Vector,
    angle: Vector,
    of_nodes: Numbers,
    distance: Vector | None = None,
    size: Vector | float = 1.0,
    area: Vector | None = None,
    covered_area: Array | None = None,
    deviation: Vector | None = None,
) -> list[dict[str, Any]]:
    """Summarise how each contact was matched; the same on all ranks. Collective.

    Arrays (k,) are of the conditions: their contacts, gaps [m], infinite where there is no
    obstacle, angles between the slave's normals and the opposite of the master's [degrees], the
    distances that the tolerance limits and the size of the facets that they are relative to [m],
    areas as weights of the mean gap, and deviations of the facets from the curved surfaces through
    their nodes [m]. Of this rank's slave nodes, paired or not, there are the contacts; of contacts
    the covered areas.
    """
    finite = np.isfinite(gap)
    contact, gap, contacts = contact[finite], gap[finite], len(names)
    weight = np.ones_like(gap) if area is None else area[finite]
    maxima: dict[str, Vector] = {
        "largest_angle": angle[finite],
        "smallest_gap": -gap,
        "largest_gap": gap,
    }
    means = {"mean_gap": gap, "weight": np.ones_like(gap)}
    if distance is not None:
        maxima["largest_distance"] = distance[finite]
        maxima["largest_relative_distance"] = (distance / size)[finite]
    if deviation is not None:
        maxima["deviation"] = deviation[finite]
        # 1 where a gap is there, but smaller than the deviation
        means["blurred"] = (gap != 0.0) & (np.abs(gap) < deviation[finite])
    none = np.zeros(contacts)
    sums: list[Array] = [np.bincount(c, minlength=contacts) for c in (contact, of_nodes)]
    sums += [none if covered_area is None else covered_area]
    sums += [np.bincount(contact, weight * values, contacts) for values in means.values()]
    totals = np.array(sums, dtype=float)
    comm.Allreduce(MPI.IN_PLACE, totals)
    columns = np.column_stack([*maxima.values()])
    largest = largest_of_groups(comm, columns, contact, contacts, -np.inf)
    largest[:, [*maxima].index("smallest_gap")] *= -1.0
    entries = []
    for k, (pairs, total, covered, *of_means) in enumerate(totals.T.tolist()):
        entry = dict.fromkeys(_ENTRIES) | {
            "contact": names[k],
            "discretisation": discretisation,
            "pairs": int(pairs),
            "unmatched": int(total - pairs),
            "covered_area": None if covered_area is None else covered,
        }
        if pairs:
            entry |= dict(zip(maxima, (0.0 + largest[k]).tolist(), strict=True))
        values = dict(zip(means, of_means, strict=True))
        whole = values.pop("weight")
        if whole > 0.0:
            entry |= {name: value / whole for name, value in values.items()}
        entries.append(entry)
    return entries


def joined_summary(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the entry of a contact from those of its parts; unmatched are none of their nodes."""
    entry, pairs = dict(parts[0]), [part["pairs"] for part in parts]
    for name in entry:
        values = [part[name] for part in parts if part[name] is not None]
        if not values or isinstance(values[0], str):
            continue
        if name in ("pairs", "covered_area"):
            entry[name] = sum(values)
        elif name in ("mean_gap", "blurred"):
            weights = [n for n, part in zip(pairs, parts, strict=True) if part[name] is not None]
            entry[name] = float(np.average(values, weights=weights))
        elif name in ("smallest_gap", "unmatched"):
            entry[name] = min(values)
        else:
            entry[name] = max(values)
    if any(part["discretisation"] == "mortar" for part in parts):
        entry["discretisation"] = "mortar"
    return entry


def warn_of_deviation(entry: Mapping[str, Any]) -> None:
    """Warn if the gaps of a contact are mostly smaller than the deviation of its facets."""
    # surfaces that touch at a point or on a line have few such nodes around it
    if (entry["blurred"] or 0.0) <= 0.5:
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
