"""Grains and discs that contact and friction alone hold in a box, meshed one by one."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from mpi4py import MPI

import gmsh
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Voronoi

import ufl

from fenics_tfeti import ContactProblem, Coulomb, Plane, RigidObstacle, find_contacts
from fenics_tfeti.io import TaggedMesh, displacement_space, read_msh, tag_facets
from fenics_tfeti.models import isotropic, small_strain

Points = NDArray[np.float64]
# edges of grains shorter than this part of the box are left out
_SHORT = 0.03


def grains(
    number: int,
    size: float,
    mu: float,
    comm: MPI.Intracomm = MPI.COMM_SELF,
    press: float = 1e-4,
    seed: int = 3,
    **options: Any,
) -> ContactProblem:
    """Return irregular grains of rock in a unit square, pressed by a piston that moves by `press`.

    They are the cells of Voronoi of relaxed random points; `size` is that of triangles.
    """
    rng = np.random.default_rng(seed)
    points = rng.random((number, 2))
    for _ in range(3):
        points = np.array([_centroid(cell) for cell in _cells(points)])

    def draw() -> None:
        geo = gmsh.model.occ
        for cell in _cells(points):
            cell = cell[np.linalg.norm(cell - np.roll(cell, 1, axis=0), axis=1) > _SHORT]
            corners = [geo.addPoint(x, y, 0.0) for x, y in cell]
            lines = [geo.addLine(a, b) for a, b in zip(corners, np.roll(corners, -1), strict=True)]
            geo.addPlaneSurface([geo.addCurveLoop(lines)])
        geo.synchronize()

    return _in_a_box(_meshed(draw, 2, size, comm), (1.0, 1.0), mu, press, options)


def grains_in_space(
    cells: tuple[int, int, int],
    size: float,
    mu: float,
    comm: MPI.Intracomm = MPI.COMM_SELF,
    press: float = 1e-4,
    seed: int = 3,
    **options: Any,
) -> ContactProblem:
    """Return polyhedral grains in a box of cubes, two for each cube, pressed by a piston.

    They are the cells of Voronoi of a moved body-centred lattice, `size` of their tetrahedra.
    """
    rng, box = np.random.default_rng(seed), np.array(cells, dtype=float)
    corners = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.vstack([corners + 0.25, corners + 0.75])
    points = points + rng.uniform(-0.08, 0.08, points.shape)

    def draw() -> None:
        geo = gmsh.model.geo
        voronoi = Voronoi(_mirrored(points, box))
        faces: dict[int, list[Any]] = {i: [] for i in range(len(points))}
        for pair, ridge in zip(voronoi.ridge_points, voronoi.ridge_vertices, strict=True):
            for i in pair:
                if i in faces:
                    faces[i].append(ridge)
        for ridges in faces.values():
            used = np.unique(np.concatenate(ridges))
            tags = {v: geo.addPoint(*voronoi.vertices[v]) for v in used}
            lines: dict[tuple[int, int], int] = {}
            surfaces = []
            for ridge in ridges:
                loop = []
                for a, b in zip(ridge, np.roll(ridge, -1), strict=True):
                    if (b, a) in lines:
                        loop.append(-lines[b, a])
                    else:
                        if (a, b) not in lines:
                            lines[a, b] = geo.addLine(tags[a], tags[b])
                        loop.append(lines[a, b])
                surfaces.append(geo.addPlaneSurface([geo.addCurveLoop(loop)]))
            geo.addVolume([geo.addSurfaceLoop(surfaces)])
        geo.synchronize()

    return _in_a_box(_meshed(draw, 3, size, comm), tuple(box), mu, press, options)


def packing(
    columns: int,
    rows: int,
    looseness: float,
    mu: float,
    comm: MPI.Intracomm = MPI.COMM_SELF,
    seed: int = 3,
    **options: Any,
) -> ContactProblem:
    """Return discs of radius 0.5 in a box that is open above, under their own weight.

    Radii are smaller by up to a random part of `looseness`.
    """
    rng = np.random.default_rng(seed)

    def draw() -> None:
        geo = gmsh.model.geo
        for j in range(rows):
            for i in range(columns - j % 2):
                radius = 0.5 * (1.0 - looseness * rng.random())
                x, y = i + 0.5 * (j % 2) + 0.5, 0.5 + j * np.sqrt(3.0) / 2.0
                centre, angle = geo.addPoint(x, y, 0.0), np.arange(12) * np.pi / 6.0
                rim = np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle)])
                points = [geo.addPoint(*point, 0.0) for point in rim]
                arcs = [
                    geo.addCircleArc(a, centre, b)
                    for a, b in zip(points, np.roll(points, -1), strict=True)
                ]
                for arc in arcs:
                    geo.mesh.setTransfiniteCurve(arc, 5)
                geo.addPlaneSurface([geo.addCurveLoop(arcs)])
        geo.synchronize()

    meshed = _meshed(draw, 2, 0.15, comm, "rims")
    mesh, rims = meshed.mesh, meshed.names["rims"]
    law = Coulomb(mu) if mu else None
    contacts = find_contacts(mesh, meshed.cell_tags, friction=law, distance=0.06)
    for name, point, normal in (
        ("floor", (0.0, 0.0), (0.0, 1.0)),
        ("left", (0.0, 0.0), (1.0, 0.0)),
        ("right", (float(columns), 0.0), (-1.0, 0.0)),
    ):
        plane = Plane(point, normal)
        contacts.append(RigidObstacle(meshed.facet_tags, rims, plane, friction=law, name=name))
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(1e4, 0.3)(u), small_strain(v)) * ufl.dx
    return ContactProblem(
        a, -1.0 * v[1] * ufl.dx, contacts=contacts, cell_tags=meshed.cell_tags, options=options
    )


def _in_a_box(
    meshed: TaggedMesh,
    box: tuple[float, ...],
    mu: float,
    press: float,
    options: dict[str, Any],
) -> ContactProblem:
    """Return the problem of grains of rock [m, Pa] between walls, a floor and a piston."""
    mesh, gdim = meshed.mesh, len(box)
    law = Coulomb(mu) if mu else None
    contacts = find_contacts(mesh, meshed.cell_tags, friction=law)
    sides = [(axis, end) for axis in range(gdim) for end in (0, 1)]
    at = [
        (lambda x, axis=axis, value=end * box[axis]: np.isclose(x[axis], value))
        for axis, end in sides
    ]
    walls = tag_facets(mesh, {1 + k: where for k, where in enumerate(at)})
    for k, (axis, end) in enumerate(sides):
        point, normal = np.zeros(gdim), (1 - 2 * end) * np.eye(gdim)[axis]
        point[axis] = end * (box[axis] - press * (axis == gdim - 1))
        name = "piston" if k == len(sides) - 1 else f"wall {k}"
        plane = Plane(tuple(point), tuple(normal))
        contacts.append(RigidObstacle(walls, 1 + k, plane, friction=law, name=name))
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(50e9, 0.25)(u), small_strain(v)) * ufl.dx
    load = -2600.0 * 9.81 * v[gdim - 1] * ufl.dx
    return ContactProblem(a, load, contacts=contacts, cell_tags=meshed.cell_tags, options=options)


def _meshed(
    draw: Any, gdim: int, size: float, comm: MPI.Intracomm, boundary: str = ""
) -> TaggedMesh:
    """Mesh bodies that do not share nodes; with a name their boundaries are tagged together."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(comm.bcast(folder)) / "bodies.msh"
        if comm.rank == 0:
            gmsh.initialize()
            gmsh.option.setNumber("General.Terminal", 0)
            draw()
            for k, body in enumerate(gmsh.model.getEntities(gdim)):
                group = gmsh.model.addPhysicalGroup(gdim, [body[1]])
                gmsh.model.setPhysicalName(gdim, group, f"grain {k}")
            rims = [tag for _, tag in gmsh.model.getEntities(gdim - 1)]
            group = gmsh.model.addPhysicalGroup(gdim - 1, rims)
            gmsh.model.setPhysicalName(gdim - 1, group, boundary or "boundaries")
            gmsh.option.setNumber("Mesh.MeshSizeMax", size)
            gmsh.model.mesh.generate(gdim)
            gmsh.write(str(path))
            gmsh.finalize()
        comm.Barrier()
        meshed = read_msh(path, comm, gdim=gdim)
        comm.Barrier()
        return meshed


def _mirrored(points: Points, box: Points) -> Points:
    """Return points, and after them their images at the sides of a box."""
    images = [points]
    for axis in range(box.size):
        for plane in (0.0, box[axis]):
            image = points.copy()
            image[:, axis] = 2.0 * plane - image[:, axis]
            images.append(image)
    return np.vstack(images)


def _cells(points: Points) -> list[Points]:
    """Return the corners of the cells of Voronoi in the unit square."""
    voronoi = Voronoi(_mirrored(points, np.ones(2)))
    return [voronoi.vertices[voronoi.regions[voronoi.point_region[i]]] for i in range(len(points))]


def _centroid(cell: Points) -> Points:
    """Return the centroid of a polygon."""
    following = np.roll(cell, -1, axis=0)
    twice = cell[:, 0] * following[:, 1] - following[:, 0] * cell[:, 1]
    centroid: Points = ((cell + following) * twice[:, None]).sum(axis=0) / (3.0 * twice.sum())
    return centroid
