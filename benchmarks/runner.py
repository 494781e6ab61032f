"""Run a benchmark, print a row for each solve, and write the rows as JSON.

    python benchmarks/run.py NAME [--option value ...] [--json FILE] [--verbose]
    python benchmarks/run.py            # lists the benchmarks
    python benchmarks/run.py NAME -h    # the options of one

Each benchmark is a module with a function `run`, whose keyword arguments are the options and which
yields rows. Options of the solver, such as `-tfeti_rtol 1e-6`, are read as in any script.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
# the scenes of the tests, and the meshes of the demos
sys.path += [str(HERE), *(str(HERE.parent / folder) for folder in ("tests/support", "meshes"))]
NAMES = [
    "accuracy",
    "adjoint",
    "beams",
    "bearing",
    "billion",
    "bricks",
    "coarse",
    "communication",
    "deflation",
    "finite_strain_suite",
    "friction",
    "general",
    "graded",
    "joint",
    "ladder",
    "materials",
    "mesh_error",
    "nonlinear",
    "peers",
    "peers_friction",
    "peers_large_sliding",
    "peers_lvpp",
    "peers_nonlinear",
    "phases",
    "products",
    "qp_solvers",
    "theory",
    "two_block",
]
Row = dict[str, Any]


def on_ranks(command: list[str], ranks: int, **more: Any) -> subprocess.CompletedProcess[Any]:
    """Run a command in processes of one thread each; `more` is for `subprocess.run`."""
    if ranks > 1:
        command = ["mpirun", "--oversubscribe", "-n", str(ranks), *command]
    variables = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    variables |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    return subprocess.run(command, env={**os.environ, **variables, **more.pop("env", {})}, **more)


def separately(name: str, ranks: int = 1, **options: Any) -> list[Row]:
    """Run a benchmark in processes of its own with one thread each, and return its rows.

    Raises RuntimeError with the last lines of its output if it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "rows.json"
        command = [sys.executable, str(HERE / "run.py"), name, "--json", str(output)]
        for option, value in options.items():
            flag = f"--{option.replace('_', '-')}"
            values = value if isinstance(value, (tuple, list)) else [value]
            if value is True:
                command.append(flag)
            elif value not in (False, None, ()):
                command += [flag, *map(str, values)]
        done = on_ranks(command, ranks, capture_output=True, text=True)
        if done.returncode:
            words = (done.stderr or done.stdout).strip().splitlines()
            raise RuntimeError("\n".join(words[-5:]) or f"exit code {done.returncode}")
        rows: list[Row] = json.loads(output.read_text())
    return rows


def parser_of(name: str, module: Any) -> argparse.ArgumentParser:
    """Return the parser of a benchmark: an option for each argument of its function `run`.

    A tuple as the default takes several values of the type of its first one.
    """
    parser = argparse.ArgumentParser(
        f"run.py {name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    choices = getattr(module, "CHOICES", {})
    for option, parameter in inspect.signature(module.run).parameters.items():
        flag, default = f"--{option.replace('_', '-')}", parameter.default
        if isinstance(default, bool):
            parser.add_argument(flag, action="store_true")
            continue
        several = isinstance(default, tuple)
        one = default[0] if several and default else default
        kind = str if one is None or several and not default else type(one)
        parser.add_argument(
            flag,
            type=kind,
            default=default,
            nargs="+" if several else None,
            choices=choices.get(option),
            help=f"default: {default}",
        )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows")
    parser.add_argument("--verbose", action="store_true", help="a line for each outer iteration")
    return parser


def written(value: Any) -> str:
    """Return a value of a table as text."""
    if isinstance(value, bool) or value is None:
        return str(value)
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def aligned(texts: Iterable[str], widths: Iterable[int]) -> str:
    """Return a line of a table."""
    return "".join(f" {text:>{width}}" for text, width in zip(texts, widths, strict=True))


def printed(rows: Iterator[Row], talks: bool, target: Path | None) -> list[Row]:
    """Print and write rows as they come, with a head where the columns change; return them all."""
    every, head = [], None
    for row in rows:
        every.append(row)
        if not talks:
            continue
        if target:
            target.write_text(json.dumps(every, indent=1) + "\n")
        flat = {name: written(x) for name, x in row.items() if not isinstance(x, dict)}
        if list(flat) != head:
            head = list(flat)
            widths = [max(len(name), len(text), 8) + 2 for name, text in flat.items()]
            print(aligned(head, widths))
        print(aligned(flat.values(), widths))
        for name, group in row.items():
            if isinstance(group, dict):
                parts = ", ".join(f"{key} {written(x)}" for key, x in group.items())
                print(f"    {name}: {parts}")
        sys.stdout.flush()
    return every


def main(arguments: list[str] | None = None) -> list[Row]:
    """Run the benchmark that the command line names; return its rows."""
    given = sys.argv[1:] if arguments is None else arguments
    if not given or given[0] not in NAMES:
        print(__doc__)
        for name in NAMES:
            source = (HERE / f"{name}.py").read_text()
            print(f"    {name:<15} {source.split(chr(10))[0].strip(chr(34))}")
        if given and given[0] not in ("-h", "--help"):
            raise SystemExit(f"there is no benchmark {given[0]!r}")
        return []
    name, *given = given
    module = importlib.import_module(name)
    options, rest = parser_of(name, module).parse_known_args(given)
    if wrong := [text for text in rest if text.startswith("--")]:
        raise SystemExit(f"{name} has no option {wrong[0]}")
    sys.argv[1:] = rest
    given_options = vars(options)
    target, verbose = given_options.pop("json"), given_options.pop("verbose")
    if verbose:
        logging.basicConfig(stream=sys.stdout, format="%(message)s", force=True)
        logging.getLogger("fenics_tfeti").setLevel(logging.INFO)
    try:
        from mpi4py import MPI

        talks = MPI.COMM_WORLD.rank == 0
    except ImportError:  # the QP solvers need no MPI
        talks = True
    return printed(module.run(**given_options), talks, target)
