"""Solve a torn system in a file: ``python -m fenics_tfeti.feti system.npz``; no dolfinx needed."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import fields
from typing import get_args, get_origin, get_type_hints

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import ContactError, Interrupted, NotConverged
from fenics_tfeti.feti import (
    Options,
    TornSolution,
    TornSolver,
    TornSystem,
    load_system,
    parse_options,
)
from fenics_tfeti.feti.files.arrays import write_arrays
from fenics_tfeti.parallel import print_on_first_rank, raise_collectively

SOLUTION_FORMAT = "fenics_tfeti solution 1"

# the exit code tells whether the iterations have converged
_OPTIONS = [f.name for f in fields(Options) if f.name != "error_if_not_converged"]
# exit codes; argparse takes 2 for wrong arguments, shells 128 + 2 for SIGINT
_SOLVED, _NOT_CONVERGED, _ERROR, _INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None, comm: MPI.Intracomm = MPI.COMM_WORLD) -> int:
    """Solve the system in a file as the command line says, and print a summary. Collective.

    Return 0 if the solution is certified, 1 if it is the last iterate only, 2 after an error, 130
    after an interruption.
    """
    parsed = _parser().parse_args(arguments)
    values = {name: getattr(parsed, name) for name in _OPTIONS}
    try:
        options = parse_options({k: v for k, v in values.items() if v is not None})
        system = load_system(parsed.system, comm)
        interrupted = False
        try:
            solution = TornSolver(system, options).solve()
        except (NotConverged, Interrupted) as error:
            if error.solution is None:
                raise
            solution, interrupted = error.solution, isinstance(error, Interrupted)
        if parsed.solution:
            save_solution(parsed.solution, system, solution)
        if parsed.report:
            solution.report.to_json(parsed.report)
    except (ContactError, OSError) as error:
        print_on_first_rank(comm, f"error: {error}", sys.stderr)
        return _ERROR
    except Interrupted as error:
        print_on_first_rank(comm, f"error: {error}", sys.stderr)
        return _INTERRUPTED
    print_on_first_rank(comm, str(solution.report))
    if interrupted:
        return _INTERRUPTED
    return _SOLVED if solution.report.converged else _NOT_CONVERGED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m fenics_tfeti.feti",
        description="Solve a contact problem given by stiffness matrices, loads, node numbers and "
        "contact rows in a file. Under mpirun each rank takes a part of the subdomains.",
    )
    parser.add_argument("system", help="npz file, as save_system writes it")
    parser.add_argument("--report", metavar="FILE", help="write the report as JSON")
    parser.add_argument(
        "--solution", metavar="FILE", help="write displacements and forces as an npz file"
    )
    options = parser.add_argument_group("options of fenics_tfeti.feti.Options")
    hints = get_type_hints(Options)
    for f in (f for f in fields(Options) if f.name in _OPTIONS):
        if hints[f.name] is bool:
            options.add_argument(f"--{f.name}", action="store_true", default=None)
            continue
        literal = get_origin(hints[f.name]) is not None
        options.add_argument(
            f"--{f.name}",
            metavar="VALUE",
            help=(" | ".join(get_args(hints[f.name])) + "; " if literal else "")
            + f"by default {f.default}",
        )
    return parser


def save_solution(path: str | os.PathLike[str], system: TornSystem, solution: TornSolution) -> None:
    """Write the solution of a torn system as an npz file, or nothing. Collective; rank 0 writes.

    The file has the ``nodes`` (n,), ascending, with their ``displacement`` (n, gdim) [m]; for each
    contact row, in the order of ranks, ``normal_force`` [N] and ``active``; for each tied row
    ``tied_force`` [N]. If rank 0 cannot write it, all ranks raise and an old file is left as it is.
    """
    comm = system.comm
    values = np.concatenate([np.zeros(0), *solution.displacements]).reshape(-1, system.gdim)
    rows = solution.normal_force, solution.active, solution.tied_force
    ranks = comm.gather((system.nodes, values, *rows))
    with raise_collectively(comm):
        if ranks is not None:
            numbers, values, *whole = (
                np.concatenate(columns) for columns in zip(*ranks, strict=True)
            )
            # copies of a node are equal
            nodes, first = np.unique(numbers, return_index=True)
            arrays = {"nodes": nodes, "displacement": values[first]}
            arrays |= zip(("normal_force", "active", "tied_force"), whole, strict=True)
            write_arrays(path, "the solution", SOLUTION_FORMAT, arrays)


if __name__ == "__main__":
    sys.exit(main())
