"""Meshes that follow the error."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from mesh_errors import block_of_triangles, roller_on

from dolfinx import fem

from fenics_tfeti import InputError, NotConverged, adapt
from fenics_tfeti.io import TaggedMesh

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(("degree", "most"), [(1, 1800), (2, 600)])
def test_roller_to_five_percent(degree, most, capsys):
    """With a third of the unknowns of a uniform mesh."""
    found = adapt(
        lambda mesh: roller_on(mesh, degree),
        block_of_triangles(COMM, 4),
        error=0.05,
        print_progress=True,
    )
    assert found.estimate.error <= 0.05
    assert found.levels[-1].unknowns < most
    assert found.problem.u.function_space.dofmap.index_map.size_global * 2 < most
    assert found.problem.report.mesh_error is not None
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(found.levels)
    assert f"{found.levels[0].unknowns} unknowns: error of the mesh about" in lines[0]


def test_ends_at_the_largest_number_of_unknowns():
    found = adapt(roller_on, block_of_triangles(COMM, 4), error=1e-3, max_unknowns=60)
    assert [level.unknowns > 60 for level in found.levels] == [False] * (len(found.levels) - 1) + [
        True
    ]


def test_new_meshes_get_sizes():
    """Structured meshes with the smallest of the sizes."""
    sizes = []

    def remesh(wanted: fem.Function) -> TaggedMesh:
        sizes.append(wanted.x.array.min())
        return block_of_triangles(COMM, int(np.ceil(0.02 / sizes[-1])))

    found = adapt(roller_on, block_of_triangles(COMM, 4), error=0.2, remesh=remesh)
    assert found.estimate.error <= 0.2
    assert 1 <= len(sizes) <= 3


def test_new_meshes_that_are_no_better_are_told():
    with pytest.raises(NotConverged, match="does remesh use the sizes"):
        adapt(
            roller_on,
            block_of_triangles(COMM, 4),
            error=0.05,
            remesh=lambda sizes: block_of_triangles(COMM, 4),
        )


@pytest.mark.parametrize(
    ("wrong", "told"),
    [({"error": 0.0}, "adapt: error"), ({"error": 0.1, "max_unknowns": 0}, "adapt: max_unknowns")],
)
def test_arguments_are_checked(wrong, told):
    with pytest.raises(InputError, match=told):
        adapt(roller_on, block_of_triangles(COMM, 1), **wrong)


def test_result_of_the_function_is_checked():
    with pytest.raises(InputError, match="a ContactProblem"):
        adapt(lambda mesh: None, block_of_triangles(COMM, 1), error=0.1)
