"""Mistakes in forms, spaces and prescribed displacements."""

import numpy as np
import scenes
from scenes import LOADED, ROLLER, SLAVE, YOUNG, elasticity, scalar_space

import ufl
from dolfinx import fem, mesh

from fenics_tfeti import ContactProblem
from fenics_tfeti.io import displacement_space
from mistakes.catalogue import beams, other_beams, posed, solved, table


def stiffness(young):
    """Return the bilinear form with another modulus, a number or a function of the scene."""
    return lambda s: elasticity(s.u, s.v, young(s) if callable(young) else s.constant(young))


def nan_in_a_cell(scene):
    """Return a modulus that is NaN in the cell of (0.1, 0.1), on whatever rank it is."""
    young = fem.Function(scalar_space(scene.mesh, "DG", 0))
    young.interpolate(lambda x: YOUNG * np.where((x[0] < 0.25) & (x[1] < 0.25), np.nan, 1.0))
    return young


def incompressible(scene):
    ratio = scene.constant(0.5)
    return scene.a + YOUNG / (1 - 2 * ratio) * ufl.div(scene.u) * ufl.div(scene.v) * ufl.dx


def on_space(space):
    """Return what solves a Laplace-like problem on a space, a function of the mesh."""

    def pose(comm):
        scene = beams(comm)
        V = space(scene.mesh)
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        right = fem.Constant(scene.mesh, 1.0) * (v[0] if v.ufl_shape else v) * ufl.dx
        a = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx
        ContactProblem(a, right, bcs=[], contacts=scene.contacts).solve()

    return pose


def load(ds):
    """Return the load on facets, a function of the scene."""
    return lambda scene: scene.traction * scene.v[1] * ds(scene)


def inner_facets(scene):
    """Return the measure of tags of which 4 is on facets inside a body."""
    inside = mesh.locate_entities(scene.mesh, 1, scenes.at(0, 0.5))
    surface = scene.facet_tags.find(SLAVE)
    facets = np.concatenate([inside, surface])
    order = np.argsort(facets)
    tags = np.repeat(np.array([4, SLAVE], dtype=np.int32), [inside.size, surface.size])
    return facet_measure(scene, mesh.meshtags(scene.mesh, 1, facets[order], tags[order]))


def same_facets(scene):
    tags = scene.facet_tags
    return facet_measure(scene, mesh.meshtags(scene.mesh, 1, tags.indices, tags.values))


def facet_measure(scene, tags):
    return ufl.Measure("ds", domain=scene.mesh, subdomain_data=tags)


def squared_gradient(scene):
    grad_u = ufl.grad(scene.u)
    return scene.a + scene.young * ufl.inner(grad_u * grad_u, ufl.grad(scene.v)) * ufl.dx


def bar(comm):
    V = scalar_space(mesh.create_unit_interval(comm, 4))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ContactProblem(ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx, 0)


MISTAKES = table(
    "Forms",
    ("NaN in a constant", solved(a=stiffness(np.nan))),
    ("NaN in one cell of a coefficient", solved(a=stiffness(nan_in_a_cell))),
    ("incompressible material", solved(a=incompressible)),
    ("NaN in the load", solved(L=lambda s: s.constant(np.nan) * s.v[1] * s.ds(LOADED))),
    (
        "NaN in a dirichlet value",
        solved(bcs=lambda s: [*s.bcs, scenes.fixed(s.V, s.facet_tags, ROLLER, 0, np.nan)]),
    ),
    ("space of degree three", on_space(lambda domain: displacement_space(domain, 3))),
    ("scalar space", on_space(scalar_space)),
    (
        "form that is not symmetric",
        solved(a=lambda s: s.a + s.constant(1e11) * s.u[1].dx(0) * s.v[0] * ufl.dx),
    ),
    ("form that is negative", solved(a=stiffness(-YOUNG))),
    ("forms exchanged", solved(a=lambda s: s.L, L=lambda s: s.a)),
    ("load on a tag of no facet", posed(L=load(lambda s: s.ds((LOADED, 99))))),
    (
        "stiffness on a tag of no cell",
        posed(a=lambda s: s.a + elasticity(s.u, s.v, s.young, s.dx(3))),
    ),
    ("load on facets inside a body", posed(L=load(lambda s: inner_facets(s)(4)))),
    (
        "load on tags of another mesh",
        posed(L=load(lambda s: facet_measure(s, other_beams(s.mesh.comm).facet_tags)(LOADED))),
    ),
    (
        "loads with two facet tags",
        posed(L=lambda s: s.L + s.traction * s.v[0] * same_facets(s)(LOADED)),
    ),
    ("forms on two meshes", solved(L=lambda s: other_beams(s.mesh.comm).L)),
    ("compiled stiffness", posed(a=lambda s: fem.form(s.a))),
    ("compiled load", posed(L=lambda s: fem.form(s.L))),
    (
        "residual for the stiffness",
        posed(a=lambda s: elasticity(fem.Function(s.V, name="w"), s.v, s.young)),
    ),
    ("form that is not linear in the trial function", posed(a=squared_gradient)),
    ("load in the stiffness", posed(a=lambda s: s.a - s.L)),
    (
        "load with the test function twice",
        posed(L=lambda s: s.L + s.traction * ufl.inner(s.v, s.v) * ufl.dx),
    ),
    ("load that is a number", posed(L=lambda s: 3.0)),
    ("no stiffness", posed(a=None)),
    ("mesh of one dimension", bar),
)
