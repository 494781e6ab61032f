"""Every face that random problems meet, with the operators on it, compared between two versions.

    python benchmarks/faces.py record FOLDER [--seeds 200] [--first 0]    # under mpirun -n R, too
    python benchmarks/faces.py compare OLD NEW

A change of form alone leaves all of it as it is, bit for bit; where forces of sites turn, sums of
two terms may differ in the last bits. Of each face that conjugate gradients meet are recorded the
rows, the sites that stick, fixed forces, curvature and proximal weight, and of a seeded x: the part
of x on the face, P x, Q x, the preconditioner's M P x, F x, C x and the gradient at the least
penetration of loose bodies. The exit code is 1 where something differs.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import runner  # noqa: F401 - the folders of the tests

from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.dual import active_set, proximal_newton
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.solution import linear

sys.path.append(str(Path(__file__).parent.parent / "tests" / "fuzz"))

# rounding errors that sums of two terms may differ by, relative to the largest entry
_ROUNDING = 4 * 2.0**-52

Record = dict[str, Any]


def properties(problem: DualProblem, operators: FaceOperators) -> Record:
    """Return what is compared of a face. Collective."""
    layout, face = problem.constraints.layout, operators.face
    x = seeded_vector(layout.numbers)
    P = operators.projector.P(face.part(x))
    found = {
        "active": face.active,
        "sticking": face.sticking,
        "fixed": face.fixed,
        "curvature": np.where(face.sticking, 0.0, face.curvature),
        "weight": np.array(0.0 if face.proximal is None else face.proximal.stiffness),
        "x": face.part(x),
        "Px": P,
        "Qx": operators.projector.Q(x),
        "Fx": layout.sum(problem.F(x)),
        "Cx": face.curved(x),
    }
    if operators.precondition is not None:
        found["MPx"] = layout.sum(operators.precondition(P))
    if operators.loose is not None:
        found["loose"] = operators.loose.at_least_penetration(x)
    return found


@contextmanager
def recording() -> Iterator[list[Record]]:
    """Append the properties of each face that conjugate gradients meet to a list."""
    faces: list[Record] = []
    modules = active_set, proximal_newton, linear
    pcpg = active_set.pcpg

    def recorded(problem: DualProblem, operators: FaceOperators, *args: Any, **more: Any) -> Any:
        faces.append(properties(problem, operators))
        return pcpg(problem, operators, *args, **more)

    for module in modules:
        module.pcpg = recorded  # type: ignore[attr-defined]
    try:
        yield faces
    finally:
        for module in modules:
            module.pcpg = pcpg  # type: ignore[attr-defined]


def record(folder: Path, seeds: range) -> None:
    """Write the faces of random torn systems, a file for each seed and rank."""
    from cases import solve_case

    comm = MPI.COMM_WORLD
    notes = comm.Dup()
    folder.mkdir(parents=True, exist_ok=True)
    number = 0
    for seed in seeds:
        with recording() as faces:
            outcome = solve_case("feti", seed, comm, notes)
        number += len(faces)
        with (folder / f"{seed}-{comm.rank}-of-{comm.size}.pickle").open("wb") as file:
            pickle.dump((outcome.kind, faces), file)
    if comm.rank == 0:
        print(f"{number} faces of {len(seeds)} problems")


def compare(old: Path, new: Path) -> int:
    """Print what differs, and return how many problems do."""
    names = sorted(path.name for path in old.glob("*.pickle"))
    wrong, faces = 0, 0
    for name in names:
        before, now = (pickle.loads((folder / name).read_bytes()) for folder in (old, new))
        faces += len(before[1])
        if difference := _difference(before, now):
            wrong += 1
            print(f"{name}: {difference}")
    print(f"{faces} faces of {len(names)} files, {wrong} differ")
    return int(wrong > 0)


def _difference(old: tuple[str, list[Record]], new: tuple[str, list[Record]]) -> str:
    if old[0] != new[0]:
        return f"outcome {old[0]} -> {new[0]}"
    for number, (before, now) in enumerate(zip(old[1], new[1], strict=False)):
        if before.keys() != now.keys():
            return f"face {number}: {sorted(before.keys() ^ now.keys())} on one side only"
        turns = before["curvature"].any() or not before["sticking"].all()
        for key, value in before.items():
            size = np.abs(value).max(initial=0.0) if value.dtype != bool else 0.0
            allowed = _ROUNDING * size if turns else 0.0
            change = np.abs(value.astype(float) - now[key]).max(initial=0.0)
            if change > allowed:
                return f"face {number}: {key} differs by {change:.1e} of {size:.1e}"
    if len(old[1]) != len(new[1]):
        return f"{len(old[1])} -> {len(new[1])} faces"
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    to_record = commands.add_parser("record")
    to_record.add_argument("folder", type=Path)
    to_record.add_argument("--seeds", type=int, default=200)
    to_record.add_argument("--first", type=int, default=0)
    to_compare = commands.add_parser("compare")
    to_compare.add_argument("old", type=Path)
    to_compare.add_argument("new", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "compare":
        return compare(arguments.old, arguments.new)
    record(arguments.folder, range(arguments.first, arguments.first + arguments.seeds))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
