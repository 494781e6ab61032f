"""Which of two surfaces is better the slave."""

from __future__ import annotations

import warnings

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from mortar_blocks import LOWER, UPPER, Blocks
from scenes import YOUNG, at, elasticity, fixed, vector_space

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, InputError
from fenics_tfeti.fem.contact.roles import roles_ratio
from fenics_tfeti.io import tag_facets

TOP, BOTTOM = 1, 2


def posed(cell="triangle", upper_young=YOUNG, lower=4, upper=4, comm=MPI.COMM_SELF, **pair):
    """Two clamped blocks, of which the upper one may be of another material."""
    shape = Blocks(cell, lower, upper)
    beams = shape.mesh(comm)
    domain, d = beams.mesh, shape.gdim
    marks = [*shape.markers()[-2:], (TOP, at(d - 1, 2.0)), (BOTTOM, at(d - 1, 0.0))]
    tags = tag_facets(domain, marks, beams.cell_tags)
    V = vector_space(domain)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dx = ufl.Measure("dx", domain=domain, subdomain_data=beams.cell_tags)
    young = [fem.Constant(domain, value) for value in (YOUNG, upper_young)]
    a = sum(elasticity(u, v, modulus, dx(k + 1)) for k, modulus in enumerate(young))
    arguments = {"slave": UPPER, "master": LOWER, "discretisation": "mortar", **pair}
    problem = ContactProblem(
        a,
        0,
        bcs=[fixed(V, tags, BOTTOM, None), fixed(V, tags, TOP, d - 1, -1e-3)],
        contacts=ContactPair(tags, **arguments),
        cell_tags=beams.cell_tags,
    )
    problem.kept = young
    return problem


def ratio_of(problem):
    return roles_ratio(problem.space.mesh.comm, problem._matched[0], problem.system.subdomains)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_ratio_of_moduli_and_sizes(cell):
    assert ratio_of(posed(cell)) == pytest.approx(1.0, rel=1e-12)
    assert ratio_of(posed(cell, upper_young=5 * YOUNG)) == pytest.approx(5.0, rel=1e-12)
    # facets half as large; cells are as high as before
    assert 1.5 < ratio_of(posed(cell, upper=8)) < 8.0


def test_bad_choice_is_a_warning():
    with pytest.warns(UserWarning, match=r"contact 0 \(pair\): the slave .* 50 times .*roles"):
        posed(upper_young=50 * YOUNG)


def test_good_choice_is_none():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        posed(upper_young=YOUNG / 50)
        posed(upper_young=50 * YOUNG, roles="auto")


@pytest.mark.parametrize(("upper_young", "slave"), [(50 * YOUNG, LOWER), (YOUNG / 50, UPPER)])
def test_automatic_roles(upper_young, slave):
    problem = posed(upper_young=upper_young, roles="auto", upper=5)
    uh = problem.solve()
    entry = problem.report.pairing[0]
    assert (entry["slave"], entry["master"]) == (slave, LOWER + UPPER - slave)
    assert entry["roles_ratio"] < 1.0
    sign = 1.0 if slave == LOWER else -1.0
    np.testing.assert_allclose(problem.contact[0].normal[:, 1], sign, rtol=1e-12)
    other = posed(upper_young=upper_young, slave=slave, master=LOWER + UPPER - slave, upper=5)
    np.testing.assert_allclose(uh.x.array, other.solve().x.array, atol=1e-9)
    # again, with the same roles
    problem.solve()
    assert problem.report.pairing[0]["slave"] == slave


def test_exact_passes_of_exchanged_roles():
    problem = posed(upper_young=50 * YOUNG, roles="auto", upper=5)
    problem.options = type(problem.options)(problem.options.solver, non_penetration="exact")
    problem.solve()
    assert problem.report.converged


def test_wrong_roles():
    with pytest.raises(InputError, match="roles is 'any'"):
        posed(roles="any")
    with pytest.raises(InputError, match="a normal belongs to the slave"):
        posed(roles="auto", normal=(0.0, -1.0))


def test_matching_nodes_have_no_roles():
    problem = scenes.two_beams(MPI.COMM_SELF, "triangle", 3).problem()
    assert ratio_of(problem) is None
