"""Problems whose solutions on much finer meshes are known, to measure errors of meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray
from scenes import Scene, at, axisymmetric_strain, dimension, elasticity, stress
from scipy.spatial import cKDTree

import basix
import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Coulomb, Plane, Sphere
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.forms import prepare_form
from fenics_tfeti.fem.mesh_error.problem import MeshErrorProblem
from fenics_tfeti.fem.topology import exterior_cell_facets
from fenics_tfeti.io import Box, TaggedMesh, boxes, tag_facets

FOOT, TOP, LEFT, RIGHT, BELOW, ABOVE, SIDE_Y = 1, 3, 2, 4, 5, 6, 7
TIGHT = {"rtol": 1e-8}


def beams(comm: MPI.Comm, n: int, degree: int = 1, cell: str = "triangle", **more: Any) -> Scene:
    """Return a cantilever that carries a beam, which has a load and is guided at its end.

    `unlike` is the number of cells along the upper beam, relative to the lower one; `metre` is what
    a metre is in the unit of length, `newton` a newton in that of force.
    """
    unlike, metre, newton = (more.get(name, 1.0) for name in ("unlike", "metre", "newton"))
    gdim = dimension(cell)
    up = gdim - 1

    def point(*x: float) -> list[float]:
        return [metre * x[0], *(metre * y for y in x[3 - gdim + 1 :])]

    m = round(n * unlike)
    parts = [
        (point(0, 0, 0), point(2, 1, 1), (2 * n, *(n,) * up)),
        (point(1, 0, 1), point(3, 1, 2), (2 * m, *(m,) * up)),
    ]
    marks = [
        (LEFT, at(0, 0.0), 1),
        (RIGHT, at(0, 3.0 * metre), 2),
        (TOP, at(up, 2.0 * metre), 2),
        (BELOW, at(up, metre), 1),
        (ABOVE, at(up, metre), 2),
    ]
    young = 2.1e11 * newton / metre**2
    scene = Scene.of_boxes(comm, cell, parts, marks, degree=degree, young=young)
    scene.fix(LEFT)
    for axis in range(up):
        scene.fix(RIGHT, axis)
    pressure = [0.0] * up + [-20e6 * newton / metre**2]
    scene.add_load(TOP, pressure)
    scene.add_pair(ABOVE, BELOW, name="joint", **more.get("pair", {}))
    return scene


def roller(comm: MPI.Comm, n: int, degree: int = 1, cell: str = "triangle", **more: Any) -> Scene:
    """Return a half, in 3D a quarter, of a block that is pressed on a rigid roller or ball."""
    gdim, grade, nu = dimension(cell), more.get("grade", 1.0), more.get("nu", 0.3)
    up = gdim - 1
    marks = [(FOOT, at(up, 0.0)), (TOP, at(up, -1.0)), (LEFT, at(0, 0.0))]
    marks += [(SIDE_Y, at(1, 0.0))] if gdim == 3 else []
    low, high = [0.0] * up + [-1.0], [1.0] * up + [0.0]
    parts = [(low, high, (n,) * gdim)]
    scene = Scene.of_boxes(
        comm, cell, parts, marks, lambda x: graded(x, grade), degree=degree, young=2e9
    )
    scene.a = elasticity(scene.u, scene.v, scene.young, poisson=nu)
    scene.fix(LEFT, 0)
    if gdim == 3:
        scene.fix(SIDE_Y, 1)
    scene.fix(TOP, up, more.get("depth", 5e-4))
    centre = (0.0,) * up + (0.05,)
    scene.add_obstacle(FOOT, Sphere(centre=centre, radius=0.05), name="roller")
    return scene


def roller_on(mesh: TaggedMesh, degree: int = 1) -> ContactProblem:
    """Return the problem of a block on a rigid roller on a mesh of `block_of_triangles`."""
    scene = Scene(mesh.mesh, mesh.facet_tags, degree=degree, young=2e9)
    scene.fix(LEFT, 0)
    scene.fix(TOP, 1, 5e-4)
    scene.add_obstacle(FOOT, Sphere(centre=(0.0, 0.05), radius=0.05), name="roller")
    return scene.problem(cell_tags=None)


def block_of_triangles(comm: MPI.Intracomm, n: int) -> TaggedMesh:
    """Return a half of the block of `roller`."""
    box = boxes(comm, [Box((0.0, -0.02), (0.02, 0.0), (n, n), "block")], "triangle")
    marks = [(FOOT, at(1, 0.0)), (TOP, at(1, -0.02)), (LEFT, at(0, 0.0))]
    return replace(box, facet_tags=tag_facets(box.mesh, marks))


def graded(x: NDArray[np.float64], grade: float) -> NDArray[np.float64]:
    return 0.02 * np.sign(x) * np.abs(x) ** grade


def ball(comm: MPI.Comm, n: int, degree: int = 1, cell: str = "triangle") -> Scene:
    """Return a cylinder that is pressed on a rigid ball, in the plane of a meridian."""
    scene = roller(comm, n, degree, cell)
    r = ufl.SpatialCoordinate(scene.mesh)[0]
    scene.weight = 2.0 * ufl.pi * r
    hooke = stress(scene.u, scene.young, strain=axisymmetric_strain)
    scene.a = ufl.inner(hooke, axisymmetric_strain(scene.v)) * scene.weight * ufl.dx
    return scene


def punch(comm: MPI.Comm, n: int, degree: int = 1, cell: str = "triangle") -> Scene:
    """Return a half of a block under a flat punch with sharp edges."""
    marks = [(FOOT, at(1, 0.0)), (TOP, at(1, -1.0)), (LEFT, at(0, 0.0))]
    scene = Scene.of_boxes(
        comm, cell, [((0.0, -1.0), (1.0, 0.0), (n, n))], marks, degree=degree, young=2e9
    )
    scene.fix(LEFT, 0)
    scene.fix(TOP)

    def flat(x: NDArray[np.float64]) -> Any:
        gap = np.where(x[0] < 0.25 * (1 + 1e-6), -1e-3, 1.0)
        return gap, np.stack([np.zeros_like(gap), np.full_like(gap, -1.0)])

    scene.add_obstacle(FOOT, flat)
    return scene


def inclusion(comm: MPI.Comm, n: int, degree: int = 1, cell: str = "triangle") -> Scene:
    """Return a half of a soft block with a stiff inclusion, pressed on a rigid roller."""
    parts = [((0.0, 0.0), (1.0, 1.0), (n, n))]
    marks = [(FOOT, at(1, 0.0)), (TOP, at(1, 1.0)), (LEFT, at(0, 0.0))]
    scene = Scene.of_boxes(comm, cell, parts, marks, degree=degree)
    young = fem.Function(_compat.lagrange_space(scene.mesh, 0, discontinuous=True))
    middle = scene.mesh.geometry.x[_compat.geometry_cells(scene.mesh)].mean(axis=1)
    is_stiff = (middle[:, 0] < 0.5) & (np.abs(middle[:, 1] - 0.5) < 0.25)
    young.x.array[:] = np.where(is_stiff, 1e9, 1e6)
    scene.a = elasticity(scene.u, scene.v, young)
    scene.fix(LEFT, 0)
    scene.fix(TOP, 1, -0.01)
    scene.add_obstacle(FOOT, Sphere(centre=(0.0, -4.0), radius=4.0))
    return scene


def slider(comm: MPI.Comm, n: int, degree: int = 1, cell: str = "triangle") -> Scene:
    """Return a block that is pressed on a plane and pushed along it, with Coulomb's friction."""
    parts = [((0.0, 0.0), (2.0, 1.0), (2 * n, n))]
    scene = Scene.of_boxes(
        comm, cell, parts, [(FOOT, at(1, 0.0)), (TOP, at(1, 1.0))], degree=degree, young=1e6
    )
    scene.fix(TOP, None, np.array([0.006, -0.01]))
    plane = Plane(point=(0.0, 0.0), normal=(0.0, 1.0))
    scene.add_obstacle(FOOT, plane, friction=Coulomb(0.3))
    return scene


def slender(comm: MPI.Comm, n: int, degree: int = 1, cell: str = "triangle") -> Scene:
    """Return a slender cantilever that bends down to a stop."""
    parts = [((0.0, 0.0), (20.0, 1.0), (10 * n, n))]
    marks = [(FOOT, at(1, 0.0)), (TOP, at(1, 1.0)), (LEFT, at(0, 0.0))]
    scene = Scene.of_boxes(comm, cell, parts, marks, degree=degree, young=1e6)
    scene.fix(LEFT)
    scene.add_load(TOP, [0.0, -5.0])
    scene.add_obstacle(FOOT, Plane(point=(0.0, -0.1), normal=(0.0, 1.0)))
    return scene


CASES: dict[str, Callable[..., Scene]] = {
    "beams": beams,
    "roller": roller,
    "graded": lambda *size: roller(*size, grade=1.6),
    "punch": punch,
    "inclusion": inclusion,
    "slider": slider,
    "slender": slender,
    "incompressible": lambda *size: roller(*size, nu=0.49),
    "ball": ball,
}


def posed(scene: Scene, **arguments: Any) -> ContactProblem:
    """Return the problem of a scene, with hardly an error of the iterations."""
    weight = getattr(scene, "weight", None)
    return scene.problem(**{"options": TIGHT, "measure_weight": weight, **arguments})


def true_error(problem: ContactProblem, fine: ContactProblem, scene: Scene) -> float:
    """Return the energy norm of the difference to a solution on a mesh within [sqrt(J)].

    `scene` is that of the finer problem; serial only.
    """
    V, Vf, gdim = problem.space, fine.space, scene.gdim
    W = _compat.lagrange_space(Vf.mesh, 2, gdim, discontinuous=True)
    dofs = _compat.cell_dofs(W)
    x = W.tabulate_dof_coordinates()[dofs]
    cells = np.arange(len(x))
    coarse = cells_at(V.mesh, x.mean(axis=1))
    differences = []
    for u, of_u in ((fine.u, cells), (problem.u, coarse)):
        at_nodes = np.repeat(of_u, dofs.shape[1]).astype(np.int32)
        differences.append(u.eval(x.reshape(-1, 3), at_nodes).reshape(len(x), -1))
    e = differences[0] - differences[1]
    v, u = scene.a.arguments()
    form = ufl.replace(scene.a, {u: ufl.TrialFunction(W), v: ufl.TestFunction(W)})
    prepared = prepare_form(Vf.mesh, form, "form", exterior_cell_facets(Vf.mesh))
    total = 0.0
    for part in np.array_split(cells.astype(np.int32), max(1, len(x) // 4000)):
        A = prepared.element_tensors(Vf.mesh, gdim * dofs.shape[1], part)
        total += np.einsum("ki,kij,kj->", e[part], A, e[part])
    return float(np.sqrt(total))


def cells_at(mesh: Any, points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the cells, which are simplices or parallelepipeds, that points (k, 3) are in."""
    gdim, name = mesh.geometry.dim, _compat.cell_name(mesh)
    x = mesh.geometry.x[_compat.geometry_cells(mesh)][..., :gdim]
    near = cKDTree(x.mean(axis=1)).query(points[:, :gdim], min(len(x), 24))[1]
    is_simplex = name in ("triangle", "tetrahedron")
    ends = [1, 2, 3] if is_simplex else [1, 2, 4]
    edges = (x[:, ends[:gdim]] - x[:, :1]).transpose(0, 2, 1)
    arm = points[:, None, :gdim] - x[near, 0]
    X = np.linalg.solve(edges[near], arm[..., None])[..., 0]
    outside = np.maximum(-X, 0.0).max(axis=2)
    over = X.sum(axis=2) if is_simplex else X.max(axis=2)
    outside = np.maximum(outside, over - 1.0)
    return near[np.arange(len(points)), outside.argmin(axis=1)]


def cells_of(problem: ContactProblem) -> MeshErrorProblem:
    """Return the problems of all cells of a solution."""
    solved, is_exact = problem._solved, problem.gaps is not None
    assert solved is not None
    return MeshErrorProblem(problem._torn, solved, problem._solution.torn_displacements, is_exact)


def distance(cells: MeshErrorProblem, way: int) -> float:
    """Return the square of the distance to the solution of one degree more [J]; serial only.

    The contact forces, as tractions shared in one way, are its loads. It is found in a space of
    continuous functions, by what the solution's own forces leave.
    """
    faces, kinds, rows = cells.faces, cells.kinds, np.arange(cells.faces.size)
    gdim, degree = faces.dim, faces.degree + 1
    A, of_cells = cells.neumann.stiffness(rows), cells.u(rows)
    b = cells.neumann.loads(rows, of_cells, np.zeros((faces.size, cells.neumann.lift.shape[1], 1)))
    b = b[..., 0]
    of_ways = cells.tractions.of(rows)
    m = of_ways[..., min(way, of_ways.shape[-1] - 1)] * kinds.contact[:, :, None, None]
    b += m.reshape(len(m), -1) @ cells.neumann.lift.T
    W = _compat.lagrange_space(faces.space.mesh, degree, gdim)
    nodes = _compat.cell_dofs(W)[faces.cells]
    dofs = (nodes[..., None] * gdim + np.arange(gdim)).reshape(len(nodes), -1)
    size = gdim * (int(nodes.max()) + 1)
    at_rows = np.repeat(dofs, dofs.shape[1], axis=1).ravel(), np.tile(dofs, dofs.shape[1]).ravel()
    K = sp.csr_matrix((A.ravel(), at_rows), (size, size))
    fixed = np.zeros((size // gdim, gdim), dtype=bool)
    closure = basix.create_element(
        basix.ElementFamily.P,
        getattr(basix.CellType, faces.kind.name),
        degree,
        basix.LagrangeVariant.gll_warped,
    ).entity_closure_dofs[gdim - 1]
    for f, of_facet in enumerate(closure):
        for c in range(gdim):
            k = kinds.free[:, f, c] & kinds.single[:, f]
            fixed[nodes[k][:, list(of_facet)].ravel(), c] = True
    free = np.flatnonzero(~fixed.ravel())
    K, load = K[free][:, free], np.bincount(dofs.ravel(), b.ravel(), size)[free]
    # bodies that contact alone holds: their loads are in equilibrium, any rigid motion will do
    held = K + 1e-10 * abs(K).max() * sp.identity(free.size)
    e = spla.spsolve(held.tocsc(), load)
    return float(e @ (K @ e))
