"""Derivatives by the places of all nodes at once."""

from functools import partial

import pytest
from sensitivity_scenes import block_on_roller, blocks, mesh_direction, tied_stack

from fenics_tfeti import BoltPreload, Coulomb, InputError, Nearest, Tresca
from fenics_tfeti.fem.displacement import owned_values
from fenics_tfeti.sensitivities import row_supports

KINDS = {
    "node pairs": partial(blocks, partners=Nearest()),
    "mortar": partial(blocks, n=4, m=5, friction=Coulomb(0.2)),
    "tied": tied_stack,
    "obstacle": partial(block_on_roller, Tresca(1.5e-3)),
    "degree 2": partial(blocks, "quadrilateral", 2, 3, degree=2),
    "bolt": partial(tied_stack, kind=BoltPreload, upper=5, axis=(0.0, 1.0), force=-3e-3),
    "axisymmetric": partial(blocks, n=4, m=5, is_axisymmetric=True),
    "3D obstacle": partial(block_on_roller, Coulomb(0.3), "hexahedron"),
}
QUICK = ("node pairs", "mortar", "tied", "obstacle")
CASES = [pytest.param(k, marks=[] if k in QUICK else pytest.mark.heavy) for k in KINDS]


def by_nodes_and_along(scene):
    """Return the derivative along a direction without a pattern by all nodes, and by itself."""
    scene.solve()
    adjoint, along = scene.adjoint(), mesh_direction(scene)
    gradient = owned_values(adjoint.by_mesh())
    slope = scene.scene.mesh.comm.allreduce(float(gradient @ owned_values(along)))
    return slope, adjoint.by_mesh(along)


@pytest.mark.parametrize("kind", CASES)
def test_by_all_nodes(kind):
    slope, along = by_nodes_and_along(KINDS[kind]())
    assert slope == pytest.approx(along, rel=1e-7)


@pytest.mark.once
def test_pairs_of_nodes_stay_pairs():
    """Also those that are found without partners."""
    found, named = (blocks(n=3, m=3, partners=partners) for partners in (None, Nearest()))
    for scene in (found, named):
        scene.solve()
    gradient, expected = (owned_values(scene.adjoint().by_mesh()) for scene in (found, named))
    assert gradient == pytest.approx(expected, rel=1e-9, abs=1e-9 * abs(expected).max())


@pytest.mark.once
def test_rows_that_depend_on_far_nodes(monkeypatch):
    """Supports that are too narrow are found out, and widened."""
    monkeypatch.setattr(row_supports, "_RINGS", 1)
    slope, along = by_nodes_and_along(blocks(n=4, m=5))
    assert slope == pytest.approx(along, rel=1e-7)


@pytest.mark.once
def test_derivatives_that_do_not_add_up(monkeypatch):
    monkeypatch.setattr(row_supports, "_SAME_SLOPE", -1.0)
    scene = block_on_roller()
    scene.solve()
    with pytest.warns(UserWarning, match="do not add up to that along a direction"):
        scene.adjoint().by_mesh()


def test_node_pairs_that_become_mortar_conditions():
    scene = blocks(n=3, m=3)
    scene.solve()
    adjoint, along = scene.adjoint(), mesh_direction(scene)
    with pytest.raises(InputError, match="name the kind of conditions by partners"):
        adjoint.by_mesh(along)
