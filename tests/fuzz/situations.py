"""Situations without a glued oracle: bodies that turn, travel, meet at nodes, are told or at rest.

Each is a function that draws a scene, solves it and returns how far the answer is from what has to
hold, in units of what is allowed: the laws of mechanics (`laws.py`), a closed form, or the answer
to the same problem described in another way, often in another frame.
"""

from __future__ import annotations

import traceback

from mpi4py import MPI

import numpy as np
import scenes_of_bodies
import scenes_of_states
import scenes_of_surfaces
from drawing import SITUATIONS, Draw, RightError
from outcome import Outcome, outcome_of

from fenics_tfeti.errors import ContactError, NotConverged

__all__ = ["scenes_of_bodies", "scenes_of_states", "scenes_of_surfaces"]


def draw_situation(seed: int) -> str:
    """Return the name of the situation of a seed."""
    names = sorted(SITUATIONS)
    weights = np.array([SITUATIONS[name][0] for name in names])
    rng = np.random.default_rng([seed, 10])
    return names[int(rng.choice(len(names), p=weights / weights.sum()))]


def solve_situation(
    seed: int, comm: MPI.Comm, notes: MPI.Comm, name: str = ""
) -> tuple[Outcome, list[str]]:
    """Solve the scene of a seed, of a given situation or a drawn one; return what was drawn, too.

    `notes` is another communicator of the same ranks, for what they tell each other in the end.
    """
    name = name or draw_situation(seed)
    draw = Draw(np.random.default_rng([seed, 9]), comm, [name])
    outcome = _outcome(name, draw)
    kinds = notes.allgather(outcome.kind)
    if len(set(kinds)) > 1:
        outcome = Outcome("ranks differ", f"{name}: by rank {kinds}; here {outcome.detail}")
    return outcome, draw.story


def _outcome(name: str, draw: Draw) -> Outcome:
    try:
        ratios = SITUATIONS[name][1](draw)
    except RightError as error:
        return Outcome("right error", f"{name}: {error}")
    except NotConverged as error:
        return Outcome("no convergence", f"{name}: {error}")
    except ContactError as error:
        return Outcome("false error", f"{name}: {type(error).__name__}: {error}")
    except Exception as error:
        return Outcome("traceback", f"{name}: {error}\n{traceback.format_exc()}")
    numbers = {what: value if value == value else np.inf for what, value in ratios.items()}
    compared = outcome_of(numbers)
    return Outcome(compared.kind, f"{name}: {compared.detail}", numbers)
