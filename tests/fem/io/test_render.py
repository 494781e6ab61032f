"""The script that draws, in a process of its own as VTK requires beside dolfinx."""

import subprocess
import sys
from pathlib import Path

import pytest

from fenics_tfeti.fem.io import pictures

pytest.importorskip("vtkmodules")

SCRIPT = str(Path(pictures.__file__).with_name("_render.py"))

EDGES_AND_MARGINS = """
import runpy, sys
import numpy as np
import pyvista
script = runpy.run_path(sys.argv[1])
square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
points = np.concatenate([square, square + [0, 1, 0]])
both = pyvista.PolyData(points, [4, 0, 1, 2, 3, 4, 4, 5, 6, 7])
both.point_data["displacement"] = np.outer([0, 0, 0, 0, 5, 5, 5, 5], [1.0, 0, 0])
edges = script["sharp_edges"](both)
ends = (edges.points + edges.point_data["displacement"])[edges.lines.reshape(-1, 3)[:, 1:]]
print(len(ends), np.ptp(ends, axis=1).max(), both.points[:, 0].max())
image = np.full((20, 30, 3), 255, dtype=np.uint8)
image[5:12, 7:19, 1] = 100
print(*script["without_margins"](image).shape)
"""


def test_edges_stay_with_their_body_and_margins_are_removed():
    """Two squares touch; the upper one is moved by 5."""
    command = [sys.executable, "-P", "-c", EDGES_AND_MARGINS, SCRIPT]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert [float(number) for number in told[0].split()] == [8.0, 1.0, 1.0]
    assert told[1].split() == ["7", "12", "3"]
