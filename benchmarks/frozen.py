"""Outcomes and products with F of many solves, compared with those that are kept in a file.

    python benchmarks/frozen.py [demos friction fuzz-1 ...]   # compares; by default all but "large"
    python benchmarks/frozen.py --keep [...]                  # renews these entries of the file
    python benchmarks/frozen.py --form [...]                  # for a change of form alone

A change of the solver that should change no answer leaves all outcomes, and nearly all counts: the
sum of each entry may differ by 3 %, a single solve by half and 20 products; with a change of form
alone by 0.2 % and two products. What is beyond is printed, and the exit code is 1. Each script runs
in a process of its own, on one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from runner import on_ranks

ROOT = Path(__file__).parent.parent
KEPT = Path(__file__).with_name("frozen.json")
FUZZ = ROOT / "tests" / "fuzz" / "run.py"


class Limits(NamedTuple):
    """What products may differ by."""

    total: float  # part of the sum of an entry
    factor: float  # of a single solve
    more: int  # products of a single solve beside that


LIMITS, OF_FORM = Limits(0.03, 1.5, 20), Limits(0.002, 1.0, 2)

# Each entry: scripts with their arguments, after the number of ranks.
ENTRIES: dict[str, list[list[str]]] = {
    "demos": [["1", f"demos/{path.name}"] for path in sorted((ROOT / "demos").glob("*.py"))],
    "beams": [
        ["1", "benchmarks/run.py", "beams"],
        ["2", "benchmarks/run.py", "beams"],
        ["1", "benchmarks/run.py", "beams", "--plain"],
        ["1", "benchmarks/run.py", "ladder", "--subdomains-per-metre", "3"],
    ],
    "bodies": [
        ["1", "benchmarks/run.py", "bearing", "--sizes", "8"],
        ["2", "benchmarks/run.py", "bearing", "--sizes", "8"],
        ["1", "benchmarks/run.py", "bearing", "--sizes", "20"],
        ["1", "benchmarks/run.py", "bricks", "--bricks", "100"],
    ],
    "friction": [
        ["1", "benchmarks/run.py", "friction", "--scene", "cubes", "--divisions", "4"],
        ["1", "benchmarks/run.py", "friction", "--scene", "plate", "--divisions", "4"],
        ["1", "benchmarks/run.py", "friction", "--scene", "belt"],
    ],
    "jumps": [["1", "benchmarks/run.py", "deflation"]],
    "fuzz-1": [["1", "fuzz", "2000"]],
    "fuzz-3": [["3", "fuzz", "200"]],
    "large": [
        ["1", "benchmarks/run.py", "bearing", "--sizes", "35"],
        ["1", "benchmarks/run.py", "ladder", "--subdomains-per-metre", "5"],
        ["1", "benchmarks/run.py", "beams", "--subdomains-per-metre", "4"],
    ],
}


def record(output: Path, script: str, arguments: list[str]) -> None:
    """Run a script in this process, and write a line for each solve of a torn system in it."""
    from fenics_tfeti.errors import ContactError
    from fenics_tfeti.feti import TornSolver

    solve = TornSolver.solve

    def recorded(self: TornSolver, *args: Any, **more: Any) -> Any:
        line: dict[str, Any]
        try:
            solution = solve(self, *args, **more)
        except ContactError as error:
            line = {"outcome": type(error).__name__, "products": 0}
            raise
        else:
            line = {"outcome": "converged", "products": solution.report.products["total"]}
            return solution
        finally:
            if self.system.comm.rank == 0:
                with output.open("a") as file:
                    print(json.dumps(line), file=file)

    TornSolver.solve = recorded  # type: ignore[method-assign]
    sys.argv = [script, *arguments]
    sys.path.insert(0, str(Path(script).parent))
    runpy.run_path(script, run_name="__main__")


def solves(ranks: int, script: str, arguments: list[str], folder: Path) -> list[dict[str, Any]]:
    """Return outcome and products of each solve of a script, or of each problem of the fuzz."""
    output = folder / "solves.json"
    output.unlink(missing_ok=True)
    if script == "fuzz":
        command = [sys.executable, str(FUZZ), "--ranks", str(ranks), "-n", arguments[0]]
        subprocess.run([*command, "--json", str(output)], stdout=subprocess.DEVNULL)
        lines = [json.loads(line) for line in output.read_text().splitlines()]
        return [
            {"outcome": line["kind"], "products": int(line["numbers"].get("products", 0))}
            for line in lines
        ]
    command = [sys.executable, __file__, "--record", str(output), str(ROOT / script), *arguments]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    quiet = {"stdout": subprocess.DEVNULL, "check": True}
    on_ranks(command, ranks, cwd=folder, env={"PYTHONPATH": path}, **quiet)
    return [json.loads(line) for line in output.read_text().splitlines()]


def measure(entry: str) -> dict[str, list[dict[str, Any]]]:
    """Return the solves of an entry by script."""
    found = {}
    for ranks, script, *arguments in ENTRIES[entry]:
        with tempfile.TemporaryDirectory() as folder:
            name = " ".join([script, *arguments, f"({ranks} ranks)"])
            found[name] = solves(int(ranks), script, arguments, Path(folder))
            print(f"  {sum(solve['products'] for solve in found[name]):6d}  {name}", flush=True)
    return found


def differences(
    kept: dict[str, list[dict[str, Any]]],
    found: dict[str, list[dict[str, Any]]],
    limits: Limits,
) -> list[str]:
    """Return a line for each outcome that differs, and for each count that differs too much."""
    lines = []
    totals = [0, 0]
    for name, solves_now in found.items():
        before = kept.get(name, [])
        if len(before) != len(solves_now):
            lines.append(f"{name}: {len(before)} solves before, {len(solves_now)} now")
            continue
        for number, (old, new) in enumerate(zip(before, solves_now, strict=True)):
            totals[0] += old["products"]
            totals[1] += new["products"]
            if old["outcome"] != new["outcome"]:
                lines.append(f"{name}, solve {number}: {old['outcome']} -> {new['outcome']}")
            elif new["products"] > limits.factor * old["products"] + limits.more:
                lines.append(f"{name}, solve {number}: {old['products']} -> {new['products']}")
    ratio = totals[1] / max(totals[0], 1)
    print(f"  {totals[0]} products before, {totals[1]} now: {ratio:.3f}")
    if abs(ratio - 1.0) > limits.total:
        lines.append(f"products {totals[0]} -> {totals[1]}")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("entries", nargs="*", choices=[*ENTRIES, []])
    parser.add_argument("--keep", action="store_true", help="write to the file")
    parser.add_argument("--form", action="store_true", help="counts differ by 2 and 0.2 %% at most")
    parser.add_argument("--file", type=Path, default=KEPT)
    if sys.argv[1:2] == ["--record"]:
        record(Path(sys.argv[2]), sys.argv[3], sys.argv[4:])
        return 0
    arguments = parser.parse_args()
    kept = json.loads(arguments.file.read_text()) if arguments.file.exists() else {}
    lines = []
    for entry in arguments.entries or [name for name in ENTRIES if name != "large"]:
        print(entry)
        found = measure(entry)
        if arguments.keep:
            kept[entry] = found
            arguments.file.write_text(json.dumps(kept) + "\n")
        else:
            limits = OF_FORM if arguments.form else LIMITS
            lines += differences(kept.get(entry, {}), found, limits)
    if not arguments.keep:
        print("\n".join(lines) or "nothing differs")
    return bool(lines)


if __name__ == "__main__":
    raise SystemExit(main())
