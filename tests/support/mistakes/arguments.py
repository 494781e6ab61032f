"""Mistakes in options and other arguments of the problem and of `solve`."""

import numpy as np
import scenes
from scenes import LOADED

from dolfinx import fem, mesh

from fenics_tfeti import Deformed
from fenics_tfeti.io import Box, boxes
from fenics_tfeti.models import follower_pressure, isotropic
from mistakes.catalogue import beams, posed, solved, table


def coarse(problem, **options):
    """Return what starts from another problem, a function of the communicator."""
    return lambda comm: beams(comm).problem(**options).solve(coarse=problem(comm))


def some_cells(scene):
    """Return tags of the cells of one body."""
    some = scene.cell_tags.find(1).astype(np.int32)
    return mesh.meshtags(scene.mesh, 2, some, np.ones(some.size, dtype=np.int32))


def follower(arguments):
    """Return what makes a pressure from arguments, a function of the scene."""
    return lambda comm: follower_pressure(*arguments(beams(comm)))


def another_name(comm):
    bodies = [Box((0, y), (1, y + 1), (1, 1), name) for y, name in enumerate(("lower", "upper"))]
    return boxes(comm, bodies, "quadrilateral").names["Upper"]


MISTAKES = table(
    "Other arguments",
    ("unknown option", posed(options={"subdomainsize": 100})),
    ("option out of range", posed(options={"rtol": -1.0})),
    ("option with an unknown value", posed(options={"preconditioner": "jacobi"})),
    ("options that are a list", posed(options=["rtol", 1e-6])),
    ("prefix of options with a dash", posed(options_prefix="-tfeti_")),
    ("subdomains of a wrong length", solved(subdomains=np.zeros(3, dtype=np.int32))),
    ("cells without a tag", solved(cell_tags=some_cells)),
    ("coarse is no problem", coarse(lambda comm: 2.0)),
    ("coarse is not solved", coarse(posed())),
    (
        "coarse of another dimension",
        coarse(lambda comm: scenes.two_beams(comm, "hexahedron", 2).problem()),
    ),
    (
        "coarse with other contacts",
        coarse(lambda comm: scenes.pressed_block(comm, "quadrilateral").problem()),
    ),
    ("coarse with another method", coarse(posed(), options={"method": "smalbe"})),
    ("gaps that are a word", posed(gaps="exact")),
    (
        "tolerance of the gaps that is negative",
        posed(gaps=lambda s: Deformed(tolerance=-1e-3)),
    ),
    ("number of passes that is a fraction", posed(gaps=lambda s: Deformed(max_passes=2.5))),
    ("cell tags that are a list", posed(cell_tags=[1, 2])),
    ("results of a problem that is not solved", lambda comm: beams(comm).problem().results[0]),
    ("report of a problem that is not solved", lambda comm: str(beams(comm).problem().report)),
    ("name that is not in the mesh", another_name),
    ("follower pressure on a trial function", follower(lambda s: (1.0, s.u, s.ds(LOADED)))),
    ("follower pressure over cells", follower(lambda s: (1.0, fem.Function(s.V), s.dx))),
    (
        "follower pressure that is a vector",
        follower(lambda s: ((0.0, 1.0), fem.Function(s.V), s.ds(LOADED))),
    ),
    ("poisson ratio of one half", lambda comm: isotropic(1e6, 0.5)),
)
