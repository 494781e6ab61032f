"""Mistakes in supports: contradictions, and bodies that move freely."""

from scenes import CLAMPED, LOADED, TRACTION, fixed

import ufl

from fenics_tfeti.errors import UnresistedMotion
from mistakes.catalogue import posed, solved, table


def beyond(scene):
    """Load the upper beam on x > 2, where nothing is below it, and no roller holds it."""
    place = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(scene.mesh)[0], 2.0), 1.0, 0.0)
    return scene.traction * place * scene.v[1] * scene.dx(2)


TITLE = "Supports"
MISTAKES = [
    *table(
        TITLE,
        (
            "two values for one displacement",
            solved(bcs=lambda s: [*s.bcs, fixed(s.V, s.facet_tags, CLAMPED, 1, 1e-3)]),
        ),
    ),
    *table(
        TITLE,
        (
            "pulled away from the contact",
            solved(L=lambda s: s.constant(TRACTION) * s.v[1] * s.ds(LOADED)),
        ),
        (
            "pushed along the contact",
            solved(L=lambda s: s.L + s.traction * s.v[0] * s.ds(LOADED), bcs=lambda s: s.bcs[:1]),
        ),
        ("tips over the edge of its support", solved(L=beyond, bcs=lambda s: s.bcs[:1])),
        ("nothing is fixed", solved(bcs=[])),
        error=UnresistedMotion,
    ),
    *table(
        TITLE,
        ("condition that is a number", posed(bcs=[0.0])),
        ("conditions that are a number", posed(bcs=0.0)),
    ),
]
