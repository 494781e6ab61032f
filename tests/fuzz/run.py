"""Run random cases: ``python tests/fuzz/run.py -n 200`` or ``--seed 123`` for one of them.

The parent starts workers, which write one line for each case; one that says nothing for `--timeout`
seconds is ended, and its case counts as a hang.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
# the package of this checkout, whatever is installed
sys.path[:0] = [str(HERE.parents[1]), str(HERE.parent / "support")]

from new_process import mpirun


def _worker(arguments: argparse.Namespace) -> None:
    """Solve the cases of a list of seeds, on all ranks of COMM_WORLD together."""
    from mpi4py import MPI

    from cases import solve_case

    comm = MPI.COMM_WORLD
    # the ranks compare notes on a communicator of their own: no message of the package gets there
    notes = comm.Dup()
    out = open(arguments.output, "a") if comm.rank == 0 else None  # noqa: SIM115
    for seed in range(
        arguments.first, arguments.first + arguments.n * arguments.stride, arguments.stride
    ):
        if not _is_alive(arguments.parent):
            break
        if out:
            print(json.dumps({"begin": seed}), file=out, flush=True)
        faulthandler.dump_traceback_later(0.8 * arguments.timeout)
        start = time.monotonic()
        outcome = solve_case(arguments.level, seed, comm, notes, arguments.situation)
        faulthandler.cancel_dump_traceback_later()
        if out:
            line = {
                "seed": seed,
                "kind": outcome.kind,
                "detail": outcome.detail,
                "numbers": outcome.numbers,
                "seconds": time.monotonic() - start,
            }
            print(json.dumps(line), file=out, flush=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


class _Workers:
    """A process (or one mpirun) that works through every `stride`-th seed, restarted on a hang."""

    def __init__(
        self, arguments: argparse.Namespace, first: int, stride: int, count: int, folder: Path
    ) -> None:
        self.arguments, self.stride = arguments, stride
        self.next, self.left = first, count
        self.path = folder / f"worker{first}.jsonl"
        self.errors = folder / f"worker{first}.err"
        self.results: list[dict[str, Any]] = []
        self._read = 0
        self._heard = time.monotonic()
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        a = self.arguments
        command = [sys.executable, str(HERE / "run.py"), "--worker", "--level", a.level]
        command += ["--situation", a.situation]
        command += ["--first", str(self.next), "-n", str(self.left), "--stride", str(self.stride)]
        command += ["--timeout", str(a.timeout), "--output", str(self.path)]
        command += ["--parent", str(os.getpid())]
        if a.ranks > 1:
            command = [*mpirun(), "-n", str(a.ranks), *command]
        environment = {
            **os.environ,
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "OMPI_ALLOW_RUN_AS_ROOT": "1",
            "OMPI_MCA_mpi_yield_when_idle": "1",
            "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
        }
        self.process = subprocess.Popen(
            command,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=open(self.errors, "ab"),  # noqa: SIM115
            start_new_session=True,
        )
        self._heard = time.monotonic()

    def look(self) -> bool:
        """Read what is new; restart after a crash or a hang. Return whether work is left."""
        assert self.process is not None
        ended = self.process.poll() is not None
        for line in self._lines():
            self._heard = time.monotonic()
            if "seed" in line:
                self._add(line)
                self.next, self.left = line["seed"] + self.stride, self.left - 1
        if self.left == 0:
            self._end()
            return False
        silent = time.monotonic() - self._heard > self.arguments.timeout
        if not ended and not silent:
            return True
        self._end()
        kind = "traceback" if ended else "hang"
        tail = self.errors.read_text(errors="replace")[-3000:]
        tail = f"the process ended with {self.process.returncode}: {tail}" if ended else tail
        self._add({"seed": self.next, "kind": kind, "detail": tail, "numbers": {}, "seconds": 0.0})
        self.next, self.left = self.next + self.stride, self.left - 1
        if self.left:
            self.start()
        return self.left > 0

    def _add(self, result: dict[str, Any]) -> None:
        self.results.append(result)
        if self.arguments.json:
            with open(self.arguments.json, "a") as file:
                print(json.dumps(result), file=file)

    def _end(self) -> None:
        """Wait for the process, which is about to end or is to be ended."""
        assert self.process is not None
        try:
            self.process.wait(timeout=10.0 if self.left == 0 else 0.0)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

    def _lines(self) -> list[dict[str, Any]]:
        if not self.path.exists():
            return []
        with open(self.path) as file:
            file.seek(self._read)
            text = file.read()
        whole = text[: text.rfind("\n") + 1]
        self._read += len(whole.encode())
        return [json.loads(line) for line in whole.splitlines()]


def run(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Run all cases; return their results by seed."""
    import tempfile

    jobs = 1 if arguments.ranks > 1 else arguments.jobs
    with tempfile.TemporaryDirectory() as folder:
        workers = []
        for j in range(min(jobs, arguments.n)):
            count = len(range(j, arguments.n, jobs))
            workers.append(_Workers(arguments, arguments.first + j, jobs, count, Path(folder)))
            workers[-1].start()
        busy = list(workers)
        try:
            while busy:
                time.sleep(0.05)
                busy = [w for w in busy if w.look()]
        finally:
            for worker in workers:
                if worker.process is not None and worker.process.poll() is None:
                    os.killpg(worker.process.pid, signal.SIGKILL)
    results = [line for worker in workers for line in worker.results]
    return sorted(results, key=lambda line: line["seed"])


def table(results: list[dict[str, Any]], kinds: tuple[str, ...]) -> str:
    """Return the table of outcomes, and the seeds of those that are not right."""
    counts = Counter(line["kind"] for line in results)
    lines = [f"{kind:20s} {counts[kind]:6d}" for kind in kinds]
    for line in results:
        if line["kind"] not in ("right", "right error"):
            detail = line["detail"].strip().split("\n")[0][:150]
            lines.append(f"  seed {line['seed']}: {line['kind']}: {detail}")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=200, help="number of cases")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--seed", type=int, help="one case, told in full")
    parser.add_argument(
        "--level",
        choices=["feti", "mesh", "both", "scenes"],
        default="both",
        help="torn systems, problems of dolfinx, every fifth seed the latter, or situations "
        "that other descriptions of them and the laws of mechanics judge",
    )
    parser.add_argument("--situation", default="", help="of the scenes, one by its name")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds for one case")
    parser.add_argument("--json", help="write each result here as it comes")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--stride", type=int, default=1, help=argparse.SUPPRESS)
    parser.add_argument("--output", help=argparse.SUPPRESS)
    parser.add_argument("--parent", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        _worker(arguments)
        return 0
    from outcome import CLASSES, FAILURES

    if arguments.seed is not None:
        from cases import tell_case

        tell_case(arguments.level, arguments.seed, arguments.situation)
        return 0
    # whoever ends this process means its workers too
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit("ended by a signal"))
    start = time.monotonic()
    if arguments.json:
        Path(arguments.json).unlink(missing_ok=True)
    results = run(arguments)
    print(table(results, CLASSES))
    print(f"{len(results)} cases, {time.monotonic() - start:.0f} s")
    bad = [line for line in results if line["kind"] in FAILURES]
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
