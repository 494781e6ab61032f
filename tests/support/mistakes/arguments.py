"""Mistakes in options and other arguments of the problem and of `solve`."""

from __future__ import annotations

import numpy as np
import scenes

from dolfinx import mesh

from fenics_tfeti import Exact
from fenics_tfeti.io import Box, boxes
from fenics_tfeti.models import isotropic
from mistakes.catalogue import beams, mistake


@mistake("subdomainsize", "subdomain_size")
def unknown_option(comm):
    beams(comm).problem(options={"subdomainsize": 100})


@mistake("rtol", "-1")
def option_out_of_range(comm):
    beams(comm).problem(options={"rtol": -1.0})


@mistake("preconditioner", "'jacobi'", "dirichlet")
def option_with_an_unknown_value(comm):
    beams(comm).problem(options={"preconditioner": "jacobi"})


@mistake("options is a list", "dictionary")
def options_that_are_a_list(comm):
    beams(comm).problem(options=["rtol", 1e-6])


@mistake("options_prefix", "'-tfeti_'", "without a dash")
def prefix_of_options_with_a_dash(comm):
    beams(comm).problem(options_prefix="-tfeti_")


@mistake("subdomains", r"\(3,\)", "cells")
def subdomains_of_a_wrong_length(comm):
    beams(comm).problem(subdomains=np.zeros(3, dtype=np.int32)).solve()


@mistake("cell_tags", "cells", "without a tag")
def cells_without_a_tag(comm):
    scene = beams(comm)
    some = scene.cell_tags.find(1).astype(np.int32)
    tags = mesh.meshtags(scene.mesh, 2, some, np.ones(some.size, dtype=np.int32))
    scene.problem(cell_tags=tags).solve()


@mistake("float", "ContactProblem", "solved")
def coarse_is_no_problem(comm):
    beams(comm).problem().solve(coarse=2.0)


@mistake("not solved", r"solve\(\)")
def coarse_is_not_solved(comm):
    beams(comm).problem().solve(coarse=beams(comm).problem())


@mistake("3 dimensions", "2")
def coarse_of_another_dimension(comm):
    beams(comm).problem().solve(coarse=scenes.two_beams(comm, "hexahedron", 2).problem())


@mistake("obstacle", "pair", "same order")
def coarse_with_other_contacts(comm):
    coarse = scenes.pressed_block(comm, "quadrilateral").problem()
    beams(comm).problem().solve(coarse=coarse)


@mistake("active_set", "smalbe", "leave it out")
def coarse_with_another_method(comm):
    coarse = beams(comm).problem()
    beams(comm).problem(options={"method": "smalbe"}).solve(coarse=coarse)


@mistake("geometry is 'exact'", r"Exact\(\)")
def geometry_that_is_a_word(comm):
    beams(comm).problem(geometry="exact")


@mistake("Exact: the tolerance", "-0.001", "largest displacement")
def tolerance_of_the_geometry_that_is_negative(comm):
    scene = beams(comm)  # mpi4py 4 hangs where an error on its way out frees a mesh
    scene.problem(geometry=Exact(tolerance=-1e-3))


@mistake("Exact: max_passes", "2.5", "integer")
def number_of_passes_that_is_a_fraction(comm):
    scene = beams(comm)
    scene.problem(geometry=Exact(max_passes=2.5))


@mistake("cell_tags", "list", "meshtags")
def cell_tags_that_are_a_list(comm):
    beams(comm).problem(cell_tags=[1, 2])


@mistake("no results", "solve")
def results_of_a_problem_that_is_not_solved(comm):
    beams(comm).problem().results[0]


@mistake("no report", r"solve\(\)")
def report_of_a_problem_that_is_not_solved(comm):
    print(beams(comm).problem().report)


@mistake("'Upper'", r"\['lower', 'upper'\]")
def name_that_is_not_in_the_mesh(comm):
    bodies = [Box((0, y), (1, y + 1), (1, 1), name) for y, name in enumerate(("lower", "upper"))]
    boxes(comm, bodies, "quadrilateral").names["Upper"]


@mistake("0.5", "between")
def poisson_ratio_of_one_half(comm):
    isotropic(1e6, 0.5)
