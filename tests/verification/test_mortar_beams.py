"""Two beams, one on the other, meshed apart: forces, energy and products as of equal meshes."""

import itertools

from mpi4py import MPI

import pytest
from scenes import CLAMPED, LOADED, MASTER, ROLLER, SLAVE, TRACTION, YOUNG, Scene, at, support_beams

pytestmark = pytest.mark.once


def report(lower, upper, ratio, exchanged=False):
    """Return the report for numbers of elements over the beams' height and a ratio of moduli."""
    parts = [((0, 0), (2, 1), (2 * lower, lower)), ((1, 1), (3, 2), (2 * upper, upper))]
    over = at(1, 1.0)
    marks = [
        (CLAMPED, at(0, 0.0), 1),
        (ROLLER, at(0, 3.0), 2),
        (LOADED, at(1, 2.0), 2),
        (SLAVE, lambda x: over(x) & (x[0] < 2.0 + 1e-9), 2),
        (MASTER, over, 1),
    ]
    young = {1: YOUNG, 2: ratio * YOUNG}
    scene = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks, young=young)
    scene.add_load(LOADED, -TRACTION)
    support_beams(scene)
    scene.add_pair(*((MASTER, SLAVE) if exchanged else (SLAVE, MASTER)), roles="given")
    problem = scene.problem(options={"rtol": 1e-8, "subdomain_size": 300})
    problem.solve()
    return problem.report


@pytest.mark.filterwarnings("ignore:contact 0")
@pytest.mark.parametrize("ratio", [1.0, 100.0])
def test_meshes_in_the_ratios_of_7_to_5_and_3_to_1(ratio):
    matching = {n: report(n, n, ratio) for n in (10, 14, 30)}
    equal = matching[10]
    assert equal.contacts[0].matching["discretisation"] == "node_to_node"
    for upper, exchanged in itertools.product((14, 30), (False, True)):
        found = report(10, upper, ratio, exchanged)
        assert found.contacts[0].matching["discretisation"] == "mortar"
        force = found.contacts[0].force[1] * (-1.0 if exchanged else 1.0)
        assert force == pytest.approx(2.0 * TRACTION, rel=1e-8)
        # the finer beam is softer
        assert 0.999 < found.energy / equal.energy < 1.05
        # of meshes that match, the finer one has smaller subdomains
        products = [r.products["total"] for r in (equal, matching[upper])]
        if found.contacts[0].roles_ratio < 20.0:
            assert found.products["total"] <= 1.3 * max(products), (upper, exchanged)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("elements", [(26, 30), (30, 60)])
def test_contact_up_to_the_edge_that_is_clamped(elements, degree):
    """Two equal cantilevers share a load at the end: half of it each, and next to nothing else."""
    thickness = 0.1
    parts = [((0, k * thickness), (1, (k + 1) * thickness), (n, 4)) for k, n in enumerate(elements)]
    marks = [
        (CLAMPED, at(0, 0.0)),
        (LOADED, at(0, 1.0), 2),
        (SLAVE, at(1, thickness), 2),
        (MASTER, at(1, thickness), 1),
    ]
    scene = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks, degree=degree)
    scene.fix(CLAMPED)
    scene.add_load(LOADED, (0.0, -TRACTION))
    scene.add_pair(roles="given")
    problem = scene.problem()
    problem.solve()
    assert problem.results[0].force[1] == pytest.approx(0.5 * thickness * TRACTION, rel=0.1)
