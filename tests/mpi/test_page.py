"""The page of a problem on several ranks."""

import base64
import gzip
import re

from mpi4py import MPI

import numpy as np
import pytest
import scenes

from fenics_tfeti import InputError
from fenics_tfeti.io import contact_fields

COMM = MPI.COMM_WORLD


def test_rank_0_writes_the_whole(shared_folder):
    folder = shared_folder
    scene = scenes.two_beams(COMM, "quadrilateral", 2)
    problem = scene.problem()
    uh = problem.solve()
    pressure = contact_fields(scene.V, problem.results).pressure
    problem.report.to_html(folder / "page.html", uh, [pressure])
    with pytest.raises(OSError, match="the page cannot be written"):
        problem.report.to_html(folder / "missing" / "page.html", uh)
    with pytest.raises(InputError, match="a scalar is expected"):
        problem.report.to_html(folder / "page.html", uh, [uh])
    COMM.barrier()
    text = (folder / "page.html").read_text()
    (packed,) = re.findall(r'id="packed">(.*?)</script>', text)
    code = gzip.decompress(base64.b64decode(packed)).decode()
    (kind, corners), *_ = re.findall(r'"i":\{"dtype":"(\w+)","bdata":"(.*?)"', code)
    # two beams of 4 x 2 squares in two triangles each; Plotly writes a slash as \u002f
    content = base64.b64decode(corners.replace("\\u002f", "/"))
    assert np.frombuffer(content, kind).size == 2 * 2 * 8
