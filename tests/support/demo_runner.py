"""Run a demo as a user does, in a folder of its own."""

from __future__ import annotations

import json
import logging
import os
import runpy
import sys
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from fenics_tfeti.fem.io import pictures

DEMOS = Path(__file__).parent.parent.parent / "demos"
UNRENDERED = Path(__file__).parent / "unrendered"
EMPTY_PICTURE = 10_000  # bytes


def run_demo(name: str, *arguments: str, folder: Path) -> dict[str, Any]:
    """Run a demo in a folder, check what it writes, and return its variables.

    Pictures of deformed meshes and profiles are not rendered, which would take most of the time;
    the data for them are checked.
    """
    root, package = logging.getLogger(), logging.getLogger("fenics_tfeti")
    before = root.handlers[:], root.level, package.level
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", [f"{name}.py", *arguments])
        patch.setenv("PYTHONPATH", str(UNRENDERED), prepend=os.pathsep)
        patch.setattr(pictures, "_plot", make_curves)
        try:
            variables = runpy.run_path(str(DEMOS / f"{name}.py"))
        finally:
            root.handlers[:], level, package_level = before
            root.setLevel(level)
            package.setLevel(package_level)
    MPI.COMM_WORLD.barrier()
    check_files(folder / "results")
    return variables


def make_curves(curves: Mapping[str, tuple[Any, Any, str]], *labels: str) -> bytes:
    """Make the curves of a profile, in place of the picture."""
    axes = Figure().add_subplot()
    for x, y, style in curves.values():
        assert len(axes.plot(x, y, style)) == 1 and np.isfinite([x, y]).any(axis=1).all()
    return not_rendered()


def not_rendered() -> bytes:
    """Return the picture that is written in place of those that are rendered."""
    picture = BytesIO()
    Image.new("RGB", (16, 10)).save(picture, "png")
    return picture.getvalue()


def check_files(results: Path) -> None:
    """Check that files were written, and that they can be read."""
    files = sorted(results.iterdir())
    assert files
    for file in files:
        if file.suffix == ".png" and file.read_bytes() != not_rendered():
            content = file.read_bytes()
            assert content.startswith(b"\x89PNG") and len(content) > EMPTY_PICTURE
        if file.suffix == ".json":
            assert json.loads(file.read_text())["converged"] is True
