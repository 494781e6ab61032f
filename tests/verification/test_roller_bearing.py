"""Roller bearings: balance, free motions, loads of the rollers, pressures along a roller."""

from __future__ import annotations

import itertools
from dataclasses import replace
from importlib import import_module

from mpi4py import MPI

import numpy as np
import pytest
from scenes import POISSON, Scene, elasticity, integral, scalar_space

from dolfinx import fem

from fenics_tfeti import PeriodicPair, Plane, RigidBody
from fenics_tfeti.io import read_msh

pytestmark = pytest.mark.once

pytest.importorskip("gmsh")
YOUNG = 2.1e11


@pytest.fixture(scope="module")
def meshes():
    """Return the script that makes the meshes."""
    return import_module("roller_bearing")


def read(meshes, path, solids):
    if MPI.COMM_WORLD.rank == 0:
        meshes.write(solids, path)
    return read_msh(path, MPI.COMM_SELF, 3)


def young(bodies, stiffer=1.0, rings=("outer ring", "inner ring")):
    """Return E, larger by a factor in rings."""
    E = fem.Function(scalar_space(bodies.mesh, "DG", 0))
    E.x.array[:] = YOUNG
    for ring in rings:
        if ring in bodies.names:
            E.x.array[bodies.cell_tags.find(bodies.names[ring])] *= stiffer
    return E


class Loaded:
    """A bearing with its loads of rollers.

    Attributes
    ----------
    problem : ContactProblem
        The problem, solved.
    loads : (rows, rollers) array
        Loads of the rollers by the outer raceway [N].
    """

    def __init__(self, meshes, path, bearing, load, *stiffer, rtol=1e-4, rigid_bodies=None):
        bodies = read(meshes, path, meshes.solids_of(bearing))
        names, self.bearing = bodies.names, bearing
        scene = Scene.of(bodies)
        scene.a = elasticity(scene.u, scene.v, young(bodies, *stiffer))
        area = integral(scene.mesh, bodies.facet_tags, names["bore"])
        scene.add_load(names["bore"], np.asarray(load) / area)
        scene.fix(names["outside"])
        rows = range(1, bearing.rows + 1)
        for row, side in itertools.product(rows, ("outer", "inner")):
            surfaces = names[f"rollers {row} {side}"], names[f"{side} raceway {row}"]
            normal = bearing.away_from_axis(row)
            scene.add_pair(*surfaces, name=f"{side} {row}", normal=normal)
        for row in rows if bearing.cage else ():
            scene.add_pair(names[f"pockets {row}"], names[f"rollers {row} side"], name=f"{row}")
        options = {"rtol": rtol, "preconditioner": "dirichlet", "deflation": "on"}
        body_of = {names[ring]: body for ring, body in (rigid_bodies or {}).items()}
        self.problem = scene.problem(options=options, rigid_bodies=body_of)
        self.problem.solve()
        self.forces = [c.nodal_normal_force @ c.normal for c in self.problem.results]
        by_outer = self.problem.results[: 2 * bearing.rows : 2]
        self.loads = np.array([self.of_rollers(c) for c in by_outer])

    def of_rollers(self, contact):
        force, k = (
            contact.nodal_normal_force[:, None] * contact.normal,
            self.bearing.roller_of(contact.coordinates.T),
        )
        return np.linalg.norm(
            [np.bincount(k, f, minlength=self.bearing.rollers) for f in force.T], axis=0
        )


def coarse(meshes, **changes):
    changes = {"layers": 4, "growth": 1.2, "coarsest": 0.03, **changes}
    return replace(meshes.small_bearing(), **changes)


def test_single_row_in_thrust(meshes, tmp_path):
    """An axial load is shared equally, balanced, and the rollers spin and slide freely."""
    bearing = coarse(meshes, rows=1)
    load = np.array([0.0, 0.0, -200e3])
    found = Loaded(meshes, tmp_path / "a.msh", bearing, load)
    outer, inner = found.forces
    np.testing.assert_allclose(outer, load, atol=1e-6 * 200e3)
    np.testing.assert_allclose(inner, -load, atol=1e-6 * 200e3)
    share = 200e3 / (8 * np.sin(bearing.alpha))
    np.testing.assert_allclose(found.loads, share, rtol=2e-3)
    report = found.problem.report
    assert report.converged
    assert report.unknowns["redundant"] == report.unknowns["dependent"] == 0
    motions = report.free_motions
    for roller in range(2, 10):
        own = [motion for motion in motions if motion.startswith(f"body {roller} ")]
        assert any("translation" in motion and "rotation" not in motion for motion in own)
        assert any("rotation" in motion and "translation" not in motion for motion in own)


@pytest.mark.heavy
def test_rigid_race(meshes, tmp_path):
    """A rigid inner ring loads the rollers as an elastic one that is 1e6 times as stiff."""
    bearing, load = coarse(meshes, rows=1), np.array([0.0, -100e3, -200e3])
    body = RigidBody((0.0, 0.0, 0.0), name="race")
    stiff, rigid = (
        Loaded(meshes, tmp_path / "a.msh", bearing, load, *stiffer, rtol=1e-7, rigid_bodies=bodies)
        for stiffer, bodies in (((1e6, ["inner ring"]), None), ((), {"inner ring": body}))
    )
    assert rigid.loads.max() > 2.0 * rigid.loads.min()
    np.testing.assert_allclose(stiff.loads, rigid.loads, rtol=1e-6)
    np.testing.assert_allclose(rigid.problem.rigid_bodies["race"].force, -load, atol=1e-5 * 200e3)


@pytest.mark.heavy
def test_two_rows_of_many_rollers_in_a_cage(meshes, tmp_path):
    """43 bodies, one of them fixed: balance, a loaded zone, and about as many products as for 18.

    The rollers are 1 mm away from the cage; nothing pushes them there.
    """
    load = np.array([0.0, -800e3, -160e3])
    small = Loaded(meshes, tmp_path / "8.msh", coarse(meshes), load)
    bearing = coarse(meshes, rollers=20, cage=True, spacing=0.03)
    found = Loaded(meshes, tmp_path / "20.msh", bearing, load)
    report = found.problem.report
    assert report.converged
    assert report.certificate.worst <= 1e-4
    assert report.products["total"] <= 1.6 * small.problem.report.products["total"]
    outer = found.forces[0] + found.forces[2]
    np.testing.assert_allclose(outer, load, atol=1e-6 * 800e3)
    np.testing.assert_allclose(found.forces[4:], 0.0, atol=1e-6 * 800e3)
    # the row that the axial load relieves carries below the axis only; the elastic rings share
    # the load between the lowest rollers
    away = np.abs((np.arange(20) + 10) % 20 - 10)
    relieved = found.loads[1]
    assert (relieved[away > 4] == 0.0).all()
    assert (np.diff(relieved[2:6]) < 0.0).all()
    np.testing.assert_allclose(relieved[:3], relieved[:3].mean(), rtol=0.02)
    np.testing.assert_allclose(
        found.loads[:, 1:], found.loads[:, :0:-1], atol=1e-3 * relieved.max()
    )


def test_meshes_have_the_bodies_and_sizes_asked_for(meshes):
    full = meshes.Bearing()
    assert full.bodies == 73
    bearing = replace(coarse(meshes), rollers=12, cage=True, spacing=0.03)
    solids = meshes.solids_of(bearing)
    assert len(solids) == bearing.bodies == 27
    for name, solid in solids.items():
        corners = solid.points[solid.cells]
        # at a corner of a hexahedron in Gmsh's order
        edges = corners[:, [1, 3, 4]] - corners[:, :1]
        assert (np.linalg.det(edges) > 0).all(), name
    r = np.linalg.norm(solids["roller 1"].points[:, :2] - [0, -bearing.pitch_radius], axis=1)
    assert r.max() < bearing.length
    two = [solids[f"roller {k}"].points for k in (1, 13)]
    np.testing.assert_allclose(two[0] * [1, 1, -1], two[1], atol=1e-15)


def single_roller(meshes, path, bearing, approach):
    """Press a roller between rigid planes; return stations, their peaks and nodal forces."""
    solid = meshes.solids_of(replace(bearing, rollers=8, rows=1, cage=False))["roller 1"]
    bodies = read(meshes, path, {"roller": solid})
    s, c = np.sin(bearing.alpha), np.cos(bearing.alpha)
    # the first roller is at -y: its axis and the direction outwards
    centre = np.array([0.0, -bearing.centre[0], bearing.centre[1]])
    axis, out = np.array([0.0, -s, c]), np.array([0.0, -c, -s])
    reach = bearing.radius - bearing.clearance / 2 - approach / 2
    scene = Scene.of(bodies)
    for side, sign in (("outer", 1), ("inner", -1)):
        flat = Plane(centre + sign * reach * out, -sign * out)
        scene.add_obstacle(bodies.names[f"rollers 1 {side}"], flat)
    problem = scene.problem(cell_tags=None, options={"rtol": 1e-5})
    problem.solve()
    outer, inner = problem.results
    assert outer.nodal_normal_force.sum() == pytest.approx(inner.nodal_normal_force.sum(), rel=1e-6)
    along = ((outer.coordinates - centre) @ axis).round(9)
    stations = np.unique(along)
    peaks = np.array([outer.pressure[along == x].max() for x in stations])
    line = np.array([outer.nodal_normal_force[along == x].sum() for x in stations])
    return stations, peaks, line


def test_line_contact(meshes, tmp_path):
    """Hertz's pressure in the middle of a roller between rigid planes, from the force there."""
    shape = {"elements": 6, "layers": 8, "growth": 1.0, "coarsest": 0.016}
    bearing = replace(meshes.Bearing(), crowning=10e-6, **shape)
    x, pressure, line = single_roller(meshes, tmp_path / "a.msh", bearing, 60e-6)
    middle = len(x) // 2
    q = line[middle] / np.gradient(x)[middle]
    hertz = np.sqrt(q * YOUNG / (1 - POISSON**2) / (np.pi * bearing.radius))
    assert pressure[middle] == pytest.approx(hertz, rel=0.05)


@pytest.mark.heavy
def test_edge_pressure(meshes, tmp_path):
    """Straight rollers press most at their ends on the longer raceway, crowned ones do not."""
    ratios = []
    for crowning in (0.0, 60e-6):
        bearing = coarse(meshes, rows=1, layers=10, shortest=0.3, crowning=crowning)
        name = tmp_path / f"{crowning}.msh"
        found = Loaded(meshes, name, bearing, np.array([0.0, 0.0, -400e3]))
        contact = found.problem.results[1]
        first = bearing.roller_of(contact.coordinates.T) == 0
        centres, axes, _ = bearing.lines(1)
        x = ((contact.coordinates[first] - centres[0]) @ axes[0]).round(9)
        stations = np.unique(x)
        line = np.array([contact.nodal_normal_force[first][x == place].sum() for place in stations])
        # half a mesh size belongs to the nodes at the ends
        size = np.gradient(stations)
        size[[0, -1]] *= 0.5
        line /= size
        ratios.append(line[[0, -1]].max() / line[len(line) // 2])
    assert ratios[0] > 1.3
    assert ratios[1] < 0.7


def rigid_rings(found, load, stiffness):
    """Return the loads of the rollers between rigid rings, for Q = stiffness d^(10/9)."""
    from scipy.optimize import fsolve

    bearing = found.bearing
    rows = range(1, bearing.rows + 1)
    centres, _, out = (
        np.concatenate(parts) for parts in zip(*map(bearing.lines, rows), strict=True)
    )
    levers = np.cross(centres, out)[:, :2]

    def loads(motion):
        approach = 1e-3 * (out @ motion[:3] + levers @ motion[3:]) - bearing.clearance
        return stiffness * np.maximum(approach, 0.0) ** (10 / 9)

    def missing(motion):
        Q = loads(motion)
        return np.append(load - Q @ out, -Q @ levers) / np.linalg.norm(load)

    return loads(fsolve(missing, [0.0, -0.1, -0.05, 0.0, 0.0])).reshape(bearing.rows, -1)


@pytest.mark.heavy
def test_load_distribution_of_rigid_rings(meshes, tmp_path):
    """The loads by Sjövall's model, and nothing outside its loaded zone; balance.

    Without clearance and crowning the model's loads do not depend on its stiffness. It leaves out
    that rollers resist a tilt of the rings, and the elastic rings.
    """
    bearing = coarse(meshes, layers=6, clearance=0.0, crowning=0.0)
    load = np.array([0.0, -800e3, -160e3])
    palmgren = 80.6e3 * (1e3 * bearing.length) ** (8 / 9) * 1e3 ** (10 / 9)
    for stiffer in (1.0, 30.0):
        found = Loaded(meshes, tmp_path / f"{stiffer}.msh", bearing, load, stiffer)
        outer = found.forces[0] + found.forces[2]
        inner = found.forces[1] + found.forces[3]
        np.testing.assert_allclose(outer, load, atol=1e-6 * 800e3)
        np.testing.assert_allclose(inner, -load, atol=1e-6 * 800e3)
        rigid = rigid_rings(found, load, palmgren)
        np.testing.assert_allclose(found.loads, rigid, atol=0.08 * rigid.max())
        assert (found.loads[rigid == 0.0] < 0.01 * rigid.max()).all()


def under_axial_load(meshes, path, sector):
    """Solve a bearing with one row of rollers, or one of its eight sectors, under an axial load."""
    bearing = replace(meshes.small_bearing(), rows=1)
    parts = 1 if sector else bearing.rollers
    bodies = read(meshes, path, meshes.solids_of(bearing, sector))
    scene, tags = Scene.of(bodies), bodies.names
    scene.fix(tags["outside"])
    scene.add_load(tags["bore"], np.array([0.0, 0.0, -1e7]))
    normal = bearing.away_from_axis(1)
    for side in ("outer", "inner"):
        scene.add_pair(tags[f"rollers 1 {side}"], tags[f"{side} raceway 1"], normal=normal)
    if sector:
        c, s = np.cos(2 * np.pi / bearing.rollers), np.sin(2 * np.pi / bearing.rollers)
        borders = tags["second border"], tags["first border"]
        turn = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        scene.contacts.append(PeriodicPair(scene.facet_tags, *borders, rotation=turn))
    problem = scene.problem(cell_tags=None, options={"rtol": 1e-9})
    problem.solve()
    pressures = [np.sort(problem.results[k].pressure) for k in range(2)]
    return problem.report.energy / parts, pressures


@pytest.mark.heavy
@pytest.mark.filterwarnings("ignore:.*clearance of the mesh")
def test_one_sector(meshes, tmp_path):
    """Energy and pressures are those of the whole ring."""
    energy, pressures = under_axial_load(meshes, tmp_path / "sector.msh", sector=True)
    whole, expected = under_axial_load(meshes, tmp_path / "whole.msh", sector=False)
    assert energy == pytest.approx(whole, rel=1e-8)
    for found, values in zip(pressures, expected, strict=True):
        np.testing.assert_allclose(
            np.repeat(found, values.size // found.size), values, atol=1e-6 * values.max()
        )
