"""Bolts that are shortened, tightened by a force, and locked."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from bolts import CUT, LOADED, flange, preload, reference_solution
from joined_bodies import block
from scenes import POISSON, Scene, at, dimension

import ufl
from dolfinx import fem

from fenics_tfeti import (
    BoltPreload,
    Deformed,
    InputError,
    NonlinearContactProblem,
    Plane,
    RigidBody,
)
from fenics_tfeti.io import Box, Interface, split_interfaces
from fenics_tfeti.models import isotropic, neo_hookean

E, FORCE = 2.1e11, 4e6
OPTIONS = {"rtol": 1e-10, "subdomain_size": 200}


def bar(cell, **data):
    """Return a bar of length 3 between two walls, cut at 1, that does not contract sideways."""
    gdim = dimension(cell)
    side = (0.5,) * (gdim - 1)
    parts = [
        Box((0.0,) * gdim, (1.0, *side), (2,) + (2,) * (gdim - 1)),
        Box((1.0,) + (0.0,) * (gdim - 1), (3.0, *side), (4,) + (2,) * (gdim - 1)),
    ]
    marks = [(1, at(0, 0.0)), (2, at(0, 3.0)), (5, at(0, 1.0), 1), (6, at(0, 1.0), 2)]
    scene = Scene.of_boxes(MPI.COMM_SELF, cell, parts, marks)
    scene.a = ufl.inner(isotropic(E, 0.0)(scene.u), ufl.grad(scene.v)) * scene.dx
    for tag in (1, 2):
        scene.fix(tag)
    scene.contacts = BoltPreload(scene.facet_tags, 5, 6, name="bolt", **data)
    return scene


@pytest.mark.parametrize(("cell", "axis"), [("quadrilateral", "x"), ("tetrahedron", None)])
def test_bar_between_walls(cell, axis):
    """P = E A s / L, whether s or P is given; the left part moves to the right, and is longer."""
    area, s = 0.5 ** (dimension(cell) - 1), 3e-4
    direction = None if axis is None else np.eye(dimension(cell))[0] * -2.0
    for data in ({"shortening": s}, {"force": E * area * s / 3.0}):
        scene = bar(cell, axis=direction, **data)
        problem = scene.problem(cell_tags=None, options={"rtol": 1e-12, "subdomain_size": 100})
        problem.solve()
        bolt = problem.results["bolt"]
        assert bolt.shortening == pytest.approx(s, rel=1e-10)
        assert bolt.tension == pytest.approx(E * area * s / 3.0, rel=1e-10)
        assert bolt.force[0] == pytest.approx(bolt.tension, rel=1e-10)
        np.testing.assert_allclose(bolt.traction[:, 0], E * s / 3.0, rtol=1e-8)
        u = problem.u.x.array.reshape(-1, dimension(cell))
        x = problem.space.tabulate_dof_coordinates()[:, 0]
        left = (x < 0.9) | (np.isclose(x, 1.0) & (u[:, 0] > 0.0))
        np.testing.assert_allclose(u[left, 0], s / 3.0 * x[left], atol=1e-9 * s)
        np.testing.assert_allclose(u[~left, 0], s / 3.0 * (x[~left] - 3.0), atol=1e-9 * s)
        report = problem.report
        assert np.abs(report.load.force).max() < 1e-9 * bolt.tension
        assert report.equilibrium < 1e-9
        walls = [reaction.force[0] for reaction in report.reactions]
        np.testing.assert_allclose(walls, [-bolt.tension, bolt.tension], rtol=1e-9)
        entry = report.contacts[0]
        np.testing.assert_allclose(entry.force_on_master, -np.array(entry.force), rtol=1e-9)


def test_report(tmp_path):
    """Bolts have a table of their own on the page."""
    pytest.importorskip("plotly")
    problem = bar("quadrilateral", shortening=3e-4).problem(cell_tags=None)
    problem.solve()
    entry = problem.report.to_dict()["contacts"][0]
    assert (entry["tension"], entry["shortening"]) == pytest.approx((E * 0.5 * 1e-4, 3e-4))
    problem.report.to_html(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "<h2>Bolts</h2>" in page and "<td>0.0003</td>" in page


def tightened(scene, force):
    problem = scene.problem(
        contacts=[*scene.contacts, preload(scene, force=force)], cell_tags=None, options=OPTIONS
    )
    return problem, problem.solve()


@pytest.mark.once
def test_load_on_a_tightened_bolt():
    """Tightened, locked, loaded: the share of the load that the bolt takes."""
    scene = flange()
    expected, s, tension = reference_solution(scene, FORCE)
    assert tension == pytest.approx(FORCE, rel=1e-9)
    problem, uh = tightened(scene, FORCE)
    size = np.abs(expected).max()
    np.testing.assert_allclose(uh.x.array.reshape(-1, 3), expected, atol=1e-8 * size)
    bolt = problem.results[-1]
    assert (bolt.shortening, bolt.tension) == pytest.approx((s, FORCE), rel=1e-8)
    problem.advance()

    load = scene.add_load(LOADED, fem.Constant(scene.mesh, [0.0, 0.0, 1e6]))
    loaded = scene.problem(
        contacts=[*scene.contacts, problem.contacts[-1].locked(bolt)],
        cell_tags=None,
        options=OPTIONS,
    )
    for pull in (1e6, 3e6):
        load.value[2] = pull
        expected, _, tension = reference_solution(scene, None, s)
        uh = loaded.solve()
        size = np.abs(expected).max()
        np.testing.assert_allclose(uh.x.array.reshape(-1, 3), expected, atol=1e-7 * size)
        assert loaded.results[-1].tension == pytest.approx(tension, rel=1e-7)
        assert loaded.results[-1].shortening == pytest.approx(s, rel=1e-8)
        assert tension > FORCE


def test_bolt_of_rubber():
    """By Newton's method: a small strain is that of Hooke's law; the force stays as it is."""
    scene = flange()
    expected, s, _ = reference_solution(scene, FORCE)
    # fifty times the strain, 1e-3
    soft, scale = 1e-3, 50.0
    u = fem.Function(scene.V)
    energy = neo_hookean(E * soft, POISSON)(u)
    residual = ufl.derivative(energy * ufl.dx, u)
    bolt = preload(scene, force=FORCE * soft * scale)
    problem = NonlinearContactProblem(residual, u, bcs=scene.bcs, contacts=[*scene.contacts, bolt])
    problem.solve()
    found = u.x.array.reshape(-1, 3) / scale
    np.testing.assert_allclose(found, expected, atol=5e-3 * np.abs(expected).max())
    assert problem.results[-1].tension == pytest.approx(bolt.force, rel=1e-6)
    assert problem.results[-1].shortening == pytest.approx(s * scale, rel=5e-3)


def turned_bar(cell, turns, **data):
    """Solve a bar of rubber whose walls turn about an end, step by step; return the last step."""
    scene = bar(cell, turns=True, **data)
    gdim, u, wall = dimension(cell), fem.Function(scene.V), fem.Function(scene.V)
    residual = ufl.derivative(neo_hookean(E, POISSON)(u) * ufl.dx, u)
    dofs = fem.locate_dofs_geometrical(scene.V, lambda x: np.isclose(x[0], 0) | np.isclose(x[0], 3))
    bc = fem.dirichletbc(wall, dofs)
    problem = NonlinearContactProblem(residual, u, bcs=[bc], contacts=scene.contacts)
    x = scene.V.tabulate_dof_coordinates()[:, :gdim]
    rotation = np.eye(gdim)
    for angle in turns:
        c, s = np.cos(angle), np.sin(angle)
        rotation[:2, :2] = [[c, -s], [s, c]]
        wall.x.array[:] = (x @ rotation.T - x).ravel()
        problem.solve()
        problem.advance()
    deformed = (x + u.x.array.reshape(x.shape)) @ rotation
    return problem, deformed - x, rotation[:, 0]


@pytest.mark.parametrize(
    ("cell", "data"), [("quadrilateral", {"force": 1e-2 * E}), ("hexahedron", {"shortening": 0.1})]
)
def test_turned_bolt(cell, data):
    """The axis turns with the cut: the stretched bar is the same but for its rotation."""
    still, expected, _ = turned_bar(cell, [0.0], **data)
    turned, found, axis = turned_bar(cell, np.radians([0.0, 10.0, 20.0, 30.0]), **data)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())
    first, second = (problem.results["bolt"] for problem in (still, turned))
    assert second.tension == pytest.approx(first.tension, rel=1e-6)
    assert second.shortening == pytest.approx(first.shortening, rel=1e-6)
    force = np.array(second.entry.force)
    np.testing.assert_allclose(np.abs(force @ axis), second.tension, rtol=1e-6)
    *_, last, end = (step.residual for step in turned.report.newton)
    assert len(turned.report.newton) <= 5 and end < 1e-2 * last


def test_held_cut_does_not_turn():
    scene = bar("quadrilateral", force=1.0, turns=True)
    scene.fix(5, 1)
    u = fem.Function(scene.V)
    residual = ufl.derivative(neo_hookean(E, POISSON)(u) * ufl.dx, u)
    problem = NonlinearContactProblem(residual, u, bcs=scene.bcs, contacts=scene.contacts)
    with pytest.raises(InputError, match=r"bolt: displacements are prescribed at 3 nodes of the"):
        problem.solve()


@pytest.mark.once
def test_three_bolts():
    """Forces are exact all at once; one after the other, the first ones get looser."""
    scene = flange(3)
    bolts = [preload(scene, k, force=FORCE, name=f"bolt {k}") for k in range(3)]
    problem = scene.problem(contacts=[*scene.contacts, *bolts], cell_tags=None, options=OPTIONS)
    problem.solve()
    together = [problem.results[bolt.name].shortening for bolt in bolts]
    for bolt in bolts:
        assert problem.results[bolt.name].tension == pytest.approx(FORCE, rel=1e-9)
    joint = problem.results[0]
    assert joint.nodal_normal_force.sum() == pytest.approx(3 * FORCE, rel=1e-8)

    order, first = (1, 0, 2), len(scene.contacts)
    problem.contacts[first:] = [replace(bolt, force=0.0) for bolt in bolts]
    tensions = []
    for k in order:
        problem.contacts[first + k] = bolts[k]
        problem.solve()
        assert problem.results[bolts[k].name].tension == pytest.approx(FORCE, rel=1e-8)
        problem.contacts[first + k] = bolts[k].locked(problem.results[bolts[k].name])
        problem.advance()
        tensions.append(problem.results["bolt 1"].tension)
    # its neighbours change the tension of the first one
    assert np.abs(np.diff(tensions)).min() > 1e-3 * FORCE
    # locked as tightened at once, each that is tightened once more stays as it is
    problem.contacts[first:] = [
        replace(bolt, force=None, shortening=s) for bolt, s in zip(bolts, together, strict=True)
    ]
    problem.contacts[first + 1] = bolts[1]
    problem.solve()
    found = [problem.results[bolt.name] for bolt in bolts]
    assert [bolt.shortening for bolt in found] == pytest.approx(together, rel=1e-7)
    assert [bolt.tension for bolt in found] == pytest.approx(3 * [FORCE], rel=1e-7)


def test_rigid_body_on_a_bolted_joint():
    """Both add bodies to those of the mesh; passes over the deformed geometry keep the force."""
    scene = flange()
    top = (0.0, 0.0, 1.0)
    block = RigidBody(top, force=(0.0, 0.0, -1e6), translation=(0, 0, None), rotation=0.0)
    scene.add_obstacle(LOADED, Plane(top, (0.0, 0.0, -1.0)), rigid_body=block)
    contacts = [*scene.contacts, preload(scene, force=FORCE)]
    problem = scene.problem(
        contacts=contacts, cell_tags=None, options=OPTIONS, gaps=Deformed(tolerance=1e-4)
    )
    problem.solve()
    bolt, body = problem.results[-1], problem.rigid_bodies[0]
    assert bolt.tension == pytest.approx(FORCE, rel=1e-8)
    assert bolt.shortening > 0.0
    assert body.force[2] == pytest.approx(1e6, rel=1e-8)
    assert body.translation[2] < 0.0
    assert problem.report.load.force[2] == pytest.approx(-1e6, rel=1e-8)


def test_cut_that_does_not_go_through():
    def tagged(x):
        return np.isclose(x[:, 0], 0.5) & (x[:, 1] < 0.5)

    whole = block("triangle", lambda x: np.ones(len(x), dtype=np.int64), tagged=tagged)
    parts = split_interfaces(whole, [Interface((1, 1), (5, 6), facets=9)])
    scene = Scene.of(parts)
    message = r"bolt 0: slave and master share 1 nodes, the first at \(0.5, 0.5\). The cut does not"
    with pytest.raises(InputError, match=message):
        scene.problem(contacts=BoltPreload(scene.facet_tags, 5, 6, force=1.0))


BOLT = BoltPreload(flange().facet_tags, CUT, CUT + 1, force=1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shortening": 1e-3}, "BoltPreload: give the force or the shortening"),
        ({"force": None}, "BoltPreload: give the force or the shortening"),
        ({"force": np.nan}, "the force is nan; a finite number"),
        ({"axis": (0.0, 0.0)}, "the axis is .* no direction"),
        ({"master": CUT}, "slave and master have the same tag 60.*split_interfaces"),
    ],
)
def test_mistakes(change, message):
    with pytest.raises(InputError, match=message):
        replace(BOLT, **change)


def test_axis_of_a_cut_that_is_not_plane():
    scene = flange()
    x = scene.mesh.geometry.x
    x[np.isclose(x, [1.5, 0.0, 0.0]).all(axis=1), 2] += 0.1
    with pytest.raises(InputError, match=r"bolt 0: the cut is not plane, .* give the axis"):
        scene.problem(contacts=preload(scene, force=1.0))
    scene.problem(contacts=preload(scene, force=1.0, axis=(0.0, 0.0, 1.0)))
