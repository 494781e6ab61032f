"""The bar of a loop: what a terminal shows, and nothing elsewhere."""

from __future__ import annotations

import io

from mpi4py import MPI

import pytest

from fenics_tfeti.fem.io.progress import progress_bar
from fenics_tfeti.io import progress


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True

    def lines(self) -> list[str]:
        """Return what stood in the line, one after the other."""
        return self.getvalue().replace("\x1b[K", "").split("\r")[1:]


@pytest.mark.parametrize(
    ("done", "seconds", "line"),
    [
        (0, 30.0, f"load step [{'.' * 30}] 0/3, 0:30"),
        (1, 60.0, f"load step [{'#' * 10}{'.' * 20}] 1/3, 1:00, 2:00 left"),
        (2, 90.0, f"load step [{'#' * 20}{'.' * 10}] 2/3, 1:30, 0:45 left"),
    ],
)
def test_bar(done, seconds, line):
    """The steps done, the time, and what is left if the others take as long."""
    assert progress_bar("load step", done, 3, seconds) == line


def test_steps():
    terminal = Terminal()
    assert list(progress("abc", "load step", MPI.COMM_SELF, terminal)) == ["a", "b", "c"]
    *lines, last = terminal.lines()
    assert [line.split(",")[0] for line in lines] == [
        progress_bar("load step", done, 3, 0.0).split(",")[0] for done in range(3)
    ]
    assert last == ""


def test_the_line_is_cleared_after_an_exception():
    terminal = Terminal()
    with pytest.raises(ZeroDivisionError):
        for step in (bar := progress([1, 0], "", MPI.COMM_SELF, terminal)):
            1 / step
    bar.close()
    assert terminal.lines()[-1] == ""
    assert terminal.lines()[0].startswith("[")


def test_nothing_is_written_to_files():
    file = io.StringIO()
    assert list(progress([1, 2], "step", MPI.COMM_SELF, file)) == [1, 2]
    assert file.getvalue() == ""


def test_no_steps():
    terminal = Terminal()
    assert list(progress([], "step", MPI.COMM_SELF, terminal)) == []
    assert terminal.lines() == [""]


def test_other_ranks_write_nothing():
    class Rank1:
        rank = 1

    terminal = Terminal()
    assert list(progress([1], "step", Rank1(), terminal)) == [1]
    assert terminal.getvalue() == ""
