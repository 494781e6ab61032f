"""Mistakes in options and other arguments of the problem and of `solve`."""

from __future__ import annotations

import numpy as np
import scenes

from dolfinx import mesh

from fenics_tfeti import Exact
from fenics_tfeti.io import Box, boxes
from fenics_tfeti.models import isotropic
from mistakes.catalogue import beams, posed, solved, table


def coarse(problem, **options):
    """Return what starts from another problem, a function of the communicator."""
    return lambda comm: beams(comm).problem(**options).solve(coarse=problem(comm))


def some_cells(scene):
    """Return tags of the cells of one body."""
    some = scene.cell_tags.find(1).astype(np.int32)
    return mesh.meshtags(scene.mesh, 2, some, np.ones(some.size, dtype=np.int32))


def another_name(comm):
    bodies = [Box((0, y), (1, y + 1), (1, 1), name) for y, name in enumerate(("lower", "upper"))]
    return boxes(comm, bodies, "quadrilateral").names["Upper"]


MISTAKES = table(
    "Other arguments",
    ("unknown option", posed(options={"subdomainsize": 100}), "subdomainsize", "subdomain_size"),
    ("option out of range", posed(options={"rtol": -1.0}), "rtol", "-1"),
    ("option with an unknown value", posed(options={"preconditioner": "jacobi"}),
     "preconditioner", "'jacobi'", "dirichlet"),
    ("options that are a list", posed(options=["rtol", 1e-6]), "options is a list", "dictionary"),
    ("prefix of options with a dash", posed(options_prefix="-tfeti_"),
     "options_prefix", "'-tfeti_'", "without a dash"),
    ("subdomains of a wrong length", solved(subdomains=np.zeros(3, dtype=np.int32)),
     "subdomains", r"\(3,\)", "cells"),
    ("cells without a tag", solved(cell_tags=some_cells), "cell_tags", "cells", "without a tag"),
    ("coarse is no problem", coarse(lambda comm: 2.0), "float", "ContactProblem", "solved"),
    ("coarse is not solved", coarse(posed()), "not solved", r"solve\(\)"),
    ("coarse of another dimension",
     coarse(lambda comm: scenes.two_beams(comm, "hexahedron", 2).problem()), "3 dimensions", "2"),
    ("coarse with other contacts",
     coarse(lambda comm: scenes.pressed_block(comm, "quadrilateral").problem()),
     "obstacle", "pair", "same order"),
    ("coarse with another method",
     coarse(posed(), options={"method": "smalbe"}),
     "active_set", "smalbe", "leave it out"),
    ("geometry that is a word", posed(geometry="exact"), "geometry is 'exact'", r"Exact\(\)"),
    ("tolerance of the geometry that is negative", posed(geometry=lambda s: Exact(tolerance=-1e-3)),
     "Exact: the tolerance", "-0.001", "largest displacement"),
    ("number of passes that is a fraction", posed(geometry=lambda s: Exact(max_passes=2.5)),
     "Exact: max_passes", "2.5", "integer"),
    ("cell tags that are a list", posed(cell_tags=[1, 2]), "cell_tags", "list", "meshtags"),
    ("results of a problem that is not solved", lambda comm: beams(comm).problem().results[0],
     "no results", "solve"),
    ("report of a problem that is not solved", lambda comm: str(beams(comm).problem().report),
     "no report", r"solve\(\)"),
    ("name that is not in the mesh", another_name, "'Upper'", r"\['lower', 'upper'\]"),
    ("poisson ratio of one half", lambda comm: isotropic(1e6, 0.5), "0.5", "between"),
)  # fmt: skip
