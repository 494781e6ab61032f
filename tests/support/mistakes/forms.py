"""Mistakes in forms, spaces and prescribed displacements."""

from __future__ import annotations

import numpy as np
import scenes
from scenes import LOADED, ROLLER, SLAVE, YOUNG

import ufl
from dolfinx import fem, mesh

from fenics_tfeti import ContactProblem
from fenics_tfeti.io import displacement_space
from mistakes.catalogue import beams, mistake


@mistake("NaN", "bilinear form", "constant 0")
def nan_in_a_constant(comm):
    scene = beams(comm)
    scene.young.value = np.nan
    scene.problem().solve()


@mistake("NaN", "bilinear form", r"coefficient 0 \(f\)")
def nan_in_one_cell_of_a_coefficient(comm):
    scene = beams(comm)
    young = fem.Function(scenes.scalar_space(scene.mesh, "DG", 0))
    # The one cell that holds the point (0.1, 0.1), on whatever rank it is.
    young.interpolate(lambda x: YOUNG * np.where((x[0] < 0.25) & (x[1] < 0.25), np.nan, 1.0))
    scene.a = scenes.elasticity(scene.u, scene.v, young)
    scene.problem().solve()


@mistake("stiffness of subdomain", "NaN or infinite", "ratio of 0.5")
def incompressible_material(comm):
    scene = beams(comm)
    ratio = scene.constant(0.5)
    scene.a += YOUNG / (1 - 2 * ratio) * ufl.div(scene.u) * ufl.div(scene.v) * ufl.dx
    scene.problem().solve()


@mistake("NaN", r"\blinear form", "constant 0")
def nan_in_the_load(comm):
    scene = beams(comm)
    scene.traction.value = np.nan
    scene.problem().solve()


@mistake("NaN", "Dirichlet condition 2")
def nan_in_a_dirichlet_value(comm):
    scene = beams(comm)
    scene.fix(ROLLER, 0, np.nan)
    scene.problem().solve()


def posed_on(scene: scenes.Scene, V) -> None:
    """Solve a Laplace-like problem on a space that the package does not support."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx
    load = fem.Constant(scene.mesh, 1.0)
    right = load * (v[0] if v.ufl_shape else v) * ufl.dx
    ContactProblem(a, right, bcs=[], contacts=scene.contacts).solve()


@mistake("degree 3", "degree 1 or 2")
def space_of_degree_three(comm):
    scene = beams(comm)
    posed_on(scene, displacement_space(scene.mesh, 3))


@mistake("scalar", "2 components")
def scalar_space(comm):
    scene = beams(comm)
    posed_on(scene, scenes.scalar_space(scene.mesh))


@mistake("symmetric", r"a\(u, v\)")
def form_that_is_not_symmetric(comm):
    scene = beams(comm)
    speed = fem.Constant(scene.mesh, 1e11)
    scene.a += speed * scene.u[1].dx(0) * scene.v[0] * ufl.dx
    scene.problem().solve()


@mistake("positive", "cell tag")
def form_that_is_negative(comm):
    scene = beams(comm)
    scene.young.value = -YOUNG
    scene.problem().solve()


@mistake("a has 1", "L has 2", "bilinear")
def forms_exchanged(comm):
    scene = beams(comm)
    scene.a, scene.L = scene.L, scene.a
    scene.problem().solve()


@mistake("linear form L", r"ds\(99\)", "boundary", r"tags there are \[1, 2, 3, 5, 6\]")
def load_on_a_tag_of_no_facet(comm):
    scene = beams(comm)
    scene.L = scene.traction * scene.v[1] * scene.ds((LOADED, 99))
    scene.problem()


@mistake("bilinear form a", r"dx\(3\)", "no cell", r"tags there are \[1, 2\]")
def stiffness_on_a_tag_of_no_cell(comm):
    scene = beams(comm)
    scene.a += scenes.elasticity(scene.u, scene.v, scene.young, scene.dx(3))
    scene.problem()


@mistake("linear form L", r"ds\(4\)", "boundary", r"tags there are \[5\]")
def load_on_facets_inside_a_body(comm):
    scene = beams(comm)
    inside = mesh.locate_entities(scene.mesh, 1, scenes.at(0, 0.5))
    surface = scene.facet_tags.find(SLAVE)
    facets = np.concatenate([inside, surface])
    order = np.argsort(facets)
    tags = np.repeat(np.array([4, SLAVE], dtype=np.int32), [inside.size, surface.size])
    ds = ufl.Measure(
        "ds",
        domain=scene.mesh,
        subdomain_data=mesh.meshtags(scene.mesh, 1, facets[order], tags[order]),
    )
    scene.L = scene.traction * scene.v[1] * ds(4)
    scene.problem()


@mistake("linear form L", "tags of another mesh")
def load_on_tags_of_another_mesh(comm):
    scene, other = beams(comm), beams(comm)
    ds = ufl.Measure("ds", domain=scene.mesh, subdomain_data=other.facet_tags)
    scene.L = scene.traction * scene.v[1] * ds(LOADED)
    scene.problem()


@mistake("linear form L", "2 different subdomain_data", "join")
def loads_with_two_facet_tags(comm):
    scene = beams(comm)
    again = mesh.meshtags(scene.mesh, 1, scene.facet_tags.indices, scene.facet_tags.values)
    ds = ufl.Measure("ds", domain=scene.mesh, subdomain_data=again)
    scene.L += scene.traction * scene.v[0] * ds(LOADED)
    scene.problem()


@mistake("a and L", "different function spaces")
def forms_on_two_meshes(comm):
    scene, other = beams(comm), beams(comm)
    scene.L = other.L
    scene.problem().solve()


@mistake("form a", "compiled", "without dolfinx.fem.form")
def compiled_stiffness(comm):
    scene = beams(comm)
    scene.a = fem.form(scene.a)
    scene.problem()


@mistake("form L", "compiled", "without dolfinx.fem.form")
def compiled_load(comm):
    scene = beams(comm)
    scene.L = fem.form(scene.L)
    scene.problem()


@mistake("no trial function", "Function 'w'", "TrialFunction", "Newton step")
def residual_for_the_stiffness(comm):
    scene = beams(comm)
    w = fem.Function(scene.V, name="w")
    scene.a = scenes.elasticity(w, scene.v, scene.young)
    scene.problem()


@mistake("a is not linear in its arguments", "Newton step")
def form_that_is_not_linear_in_the_trial_function(comm):
    scene = beams(comm)
    grad_u = ufl.grad(scene.u)
    scene.a += scene.young * ufl.inner(grad_u * grad_u, ufl.grad(scene.v)) * ufl.dx
    scene.problem()


@mistake("a is not linear in its arguments", "ufl.lhs and ufl.rhs")
def load_in_the_stiffness(comm):
    scene = beams(comm)
    scene.a -= scene.L
    scene.problem()


@mistake("L is not linear in its arguments", "test function")
def load_with_the_test_function_twice(comm):
    scene = beams(comm)
    scene.L += scene.traction * ufl.inner(scene.v, scene.v) * ufl.dx
    scene.problem()


@mistake("form L", "float", "form of UFL")
def load_that_is_a_number(comm):
    scene = beams(comm)
    scene.L = 3.0
    scene.problem()


@mistake("form a", "NoneType", "form of UFL")
def no_stiffness(comm):
    scene = beams(comm)
    scene.a = None
    scene.problem()


@mistake("interval", "two or three dimensions")
def mesh_of_one_dimension(comm):
    bar = mesh.create_unit_interval(comm, 4)
    V = scenes.scalar_space(bar)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ContactProblem(ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx, 0)
