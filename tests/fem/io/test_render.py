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


COMPOSED = """
import runpy, sys
import numpy as np
from matplotlib.image import imread
script = runpy.run_path(sys.argv[1])
image = np.zeros((40, 400, 3), dtype=np.uint8)
image[:, :, 0] = 255
data = {"size": np.array([1600, 1000]), "title": "", "note": "", "colour_map": "Greys",
        "label": "mmmmmmmmmm stress [MPa]", "exceeded": False}
script["compose"](data, image, (0.0, 1.0), sys.argv[2])
pixels = imread(sys.argv[2])[:, :, :3]
red = (pixels[:, :, 0] > 0.9) & (pixels[:, :, 1] < 0.1)
dark = pixels.max(axis=2) < 0.7
print(*(np.flatnonzero(part.any(axis=0))[end] for part, end in ((red, 0), (red, -1), (dark, 0))))
"""


def test_long_bodies_end_before_the_label_of_the_colour_bar(tmp_path):
    command = [sys.executable, "-P", "-c", COMPOSED, SCRIPT, str(tmp_path / "a.png")]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    left, right, label = map(int, told)
    assert right - left > 0.75 * 1600
    assert right < label
