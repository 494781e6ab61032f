"""The displacement space, prescribed values, and the function put together from subdomains."""

import gc
import weakref

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from curved_rings import quarter_rings
from scenes import CLAMPED, ROLLER, SIDE_X

import ufl
from dolfinx import fem

from fenics_tfeti import InputError
from fenics_tfeti.fem.displacement import fill_displacement, prescribed_values, space_of_forms
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.io import displacement_space

COMM = MPI.COMM_SELF


def beams():
    return scenes.two_beams(COMM, "quadrilateral", 3)


def forms_on(V):
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    return ufl.inner(u, v) * ufl.dx, fem.Constant(V.mesh, 1.0) * v[0] * ufl.dx


def test_curved_cells_need_displacements_of_degree_2(tmp_path):
    domain = quarter_rings(tmp_path / "a.msh", (4, 6), ((0.5, 1.0), (1.0, 1.6)), True).mesh
    V = displacement_space(domain, 2)
    assert space_of_forms(*forms_on(V)) == V
    with pytest.raises(InputError, match="curved cells, of degree 2, and the displacement is of"):
        space_of_forms(*forms_on(displacement_space(domain)))


def prescribed_at(scene, bcs):
    """Return {(x, y, component): value}."""
    found = prescribed_values(scene.V, bcs)
    x = np.round(scene.V.tabulate_dof_coordinates()[found.nodes], 12)
    keys = zip(x[:, 0], x[:, 1], found.components, strict=True)
    return dict(zip(keys, found.values, strict=True))


def test_condition_on_a_component_prescribes_that_component():
    scene = beams()
    found = prescribed_at(scene, [scenes.fixed(scene.V, scene.facet_tags, CLAMPED, 1, 0.25)])
    assert len(found) == 4
    assert {(x, component, value) for (x, _, component), value in found.items()} == {(0, 1, 0.25)}


def test_condition_on_the_space_prescribes_all_components():
    scene = beams()
    found = prescribed_at(scene, [scenes.fixed(scene.V, scene.facet_tags, CLAMPED, None)])
    assert len(found) == 2 * 4


def test_empty_condition_is_told():
    scene = beams()
    nothing = fem.dirichletbc(np.zeros(2), np.zeros(0, dtype=np.int32), scene.V)
    with pytest.warns(UserWarning, match="Dirichlet condition 1 prescribes nothing"):
        prescribed_values(scene.V, [scene.bcs[0], nothing])


def test_equal_values_by_two_conditions_are_no_contradiction():
    scene = beams()
    one = scenes.fixed(scene.V, scene.facet_tags, ROLLER, 0, 0.3)
    other = scenes.fixed(scene.V, scene.facet_tags, ROLLER, 0, 0.3 + 1e-16)
    assert set(prescribed_at(scene, [one, other]).values()) == {0.3 + 1e-16}


def test_condition_on_another_space_is_refused():
    scene, other = beams(), scenes.pressed_block(COMM, "quadrilateral", 2)
    wrong = scenes.fixed(other.V, other.facet_tags, SIDE_X, 0)
    with pytest.raises(InputError, match="Dirichlet condition 1 is not on the displacement's"):
        prescribed_values(scene.V, [scene.bcs[0], wrong])


def test_function_has_the_displacements_of_the_subdomains():
    scene = beams()
    x = scene.V.tabulate_dof_coordinates()[:, :2]
    halves = [np.flatnonzero(x[:, 0] < 1.1), np.flatnonzero(x[:, 0] > 0.9)]
    none = np.zeros(0)
    subdomains = [Subdomain(None, none, x[nodes], nodes, 0) for nodes in halves]
    parts = [3.0 * x[nodes].ravel() for nodes in halves]
    uh = fill_displacement(fem.Function(scene.V), subdomains, parts)
    np.testing.assert_array_equal(uh.x.array, 3.0 * x.ravel())


def test_nothing_keeps_the_mesh_of_a_problem_that_is_gone():
    """A process may have many meshes one after the other, but few communicators."""
    scene = scenes.pressed_block(MPI.COMM_SELF, "quadrilateral")
    problem = scene.problem()
    problem.solve()
    mesh = weakref.ref(scene.mesh)
    del scene, problem
    gc.collect()
    assert mesh() is None
