"""Mistakes in supports: contradictions, and bodies that move freely."""

from __future__ import annotations

import scenes
from scenes import CLAMPED, LOADED

import ufl

from fenics_tfeti.errors import UnresistedMotion
from mistakes.catalogue import beams, mistake


@mistake("(?i)contradictory", r"component 1 at \(0, 0\)", "0.001", "condition 2")
def two_values_for_one_displacement(comm):
    scene = beams(comm)
    scene.fix(CLAMPED, 1, 1e-3)
    scene.problem().solve()


@mistake("body 1", "cell tag 2", r"translation along \(0, 1\)", error=UnresistedMotion)
def pulled_away_from_the_contact(comm):
    scene = beams(comm)
    scene.traction.value = +scenes.TRACTION
    scene.problem().solve()


@mistake("body 1", "cell tag 2", r"translation along \(-1, 0\)", error=UnresistedMotion)
def pushed_along_the_contact(comm):
    scene = beams(comm)
    scene.L += scene.traction * scene.v[0] * scene.ds(LOADED)
    scene.bcs = scene.bcs[:1]
    scene.problem().solve()


@mistake("body 1", "cell tag 2", r"rotation through \(2, ", error=UnresistedMotion)
def tips_over_the_edge_of_its_support(comm):
    """The load stands on x > 2, where nothing is below the upper beam, and no roller holds it."""
    scene = beams(comm)
    beyond = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(scene.mesh)[0], 2.0), 1.0, 0.0)
    scene.L = scene.traction * beyond * scene.v[1] * scene.dx(2)
    scene.bcs = scene.bcs[:1]
    scene.problem().solve()


@mistake("body 0", "cell tag 1", "body 1", "cell tag 2", error=UnresistedMotion)
def nothing_is_fixed(comm):
    scene = beams(comm)
    scene.problem(bcs=[]).solve()


@mistake("Dirichlet condition 0", "float", "dirichletbc")
def condition_that_is_a_number(comm):
    beams(comm).problem(bcs=[0.0])


@mistake("bcs is a float", "list of Dirichlet conditions")
def conditions_that_are_a_number(comm):
    beams(comm).problem(bcs=0.0)
