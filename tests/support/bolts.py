"""Plates that bolts hold together, of cubes; the shanks are cut in the plane of the joint."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import primal_reference as reference
import scipy.sparse as sp
from mesh_arrays import concatenated, grid, mesh_of, tags_of
from numpy.typing import NDArray
from scenes import Scene

from dolfinx import fem
from dolfinx.fem import petsc
from dolfinx.mesh import locate_entities, meshtags

from fenics_tfeti import BoltPreload
from fenics_tfeti.io import Interface, TaggedMesh, split_interfaces, tag_facets

UPPER, LOWER, HELD, LOADED, JOINT, SEAT, CUT = 1, 2, 10, 3, 20, 30, 60
SHANK, HEAD, THICK = 0.5, 1.0, 1.0  # half widths of shank and head, thickness of a plate and a head


def flange(bolts: int = 1, n: int = 2, comm: Any = MPI.COMM_SELF) -> Scene:
    """Return plates with so many bolts in holes, 3 apart; they have n elements in a length of 1.

    The lower plate is held at its right end, the upper one loaded there. Contacts are the joint,
    then head and nut of each bolt. The cut of bolt k has the tags CUT + 2k, on the upper side, and
    CUT + 2k + 1.
    """
    width, depth = 3.0 * bolts + 2.0, 3.0
    places = 3.0 * np.arange(bolts) + 1.5
    shape = width, depth, 2 * (THICK + HEAD)
    points, cells = grid(tuple(round(length * n) for length in shape))
    points = points / n - [0.0, depth / 2, THICK + HEAD]
    middle = points[cells].mean(axis=1)
    near = np.abs(middle[:, :1] - places)
    r = np.maximum(near.min(axis=1), np.abs(middle[:, 1]))
    z = np.abs(middle[:, 2])
    is_bolt = (r < SHANK) | ((r < HEAD) & (z > THICK))
    body = np.where(is_bolt, 2 * near.argmin(axis=1) + 3, 1) + (middle[:, 2] < 0.0)
    body[~is_bolt & (z > THICK)] = 0
    parts, tags = [], list[int]()
    for tag in range(1, 2 * bolts + 3):
        chosen = cells[body == tag]
        used, numbers = np.unique(chosen, return_inverse=True)
        parts.append((points[used], numbers.reshape(chosen.shape)))
        tags += [tag] * len(chosen)
    domain = mesh_of(comm, "hexahedron", *concatenated(*parts))
    cell_tags = tags_of(domain, tags)

    def on(level: float, low: float = -np.inf, high: float = np.inf, half: float = np.inf) -> Any:
        return lambda x: (
            np.isclose(x[2], level)
            & (x[0] >= low - 1e-9)
            & (x[0] <= high + 1e-9)
            & (np.abs(x[1]) <= half + 1e-9)
        )

    markers = [(JOINT, on(0.0), UPPER), (JOINT + 1, on(0.0), LOWER)]
    markers += [(LOADED, on(THICK, width - 1.0), UPPER), (HELD, on(-THICK, width - 1.0), LOWER)]
    for k, place in enumerate(places):
        head, nut, seat = 2 * k + 3, 2 * k + 4, SEAT + 4 * k
        markers += [(CUT + 2 * k, on(0.0), head), (CUT + 2 * k + 1, on(0.0), nut)]
        under = place - HEAD, place + HEAD, HEAD
        markers += [(seat, on(THICK), head), (seat + 1, on(THICK, *under), UPPER)]
        markers += [(seat + 2, on(-THICK), nut), (seat + 3, on(-THICK, *under), LOWER)]
    scene = Scene(domain, tag_facets(domain, markers, cell_tags), cell_tags)
    scene.fix(HELD)
    for level in (JOINT, *(SEAT + 2 * k for k in range(2 * bolts))):
        scene.add_pair(level, level + 1, roles="given")
    # no motion along the plates, in which nothing holds the bolts
    for axis in range(2):
        part = scene.V.sub(axis).collapse()[0]
        dofs = fem.locate_dofs_geometrical((scene.V.sub(axis), part), _on_axes(width, places))
        scene.bcs.append(fem.dirichletbc(fem.Function(part), dofs, scene.V.sub(axis)))
    return scene


def _on_axes(width: float, places: Any) -> Any:
    """Return a marker of points at the right end, and in planes through the axes of the bolts."""

    def marker(x: NDArray[np.float64]) -> NDArray[np.bool_]:
        in_bolt = (np.abs(np.subtract.outer(x[0], places)) < 0.51).any(axis=1)
        in_bolt &= np.abs(x[1]) < 0.51
        end = np.isclose(x[0], width)
        axes = np.isclose(np.subtract.outer(x[0], places), 0.0).any(axis=1) | np.isclose(x[1], 0.0)
        return end | (in_bolt & axes)

    return marker


def tapped_plate() -> dict[str, Any]:
    """Return a plate on a table, with a bolt that is threaded into it, as variables of a script.

    The mesh has one node at each place but between plate and bolt, and plate and table.
    """
    n, half = 2, 2.0
    points, cells = grid((8, 8, 6))
    points = points / n - [half, half, 1.0]
    middle = points[cells].mean(axis=1)
    r, z = np.abs(middle[:, :2]).max(axis=1), middle[:, 2]
    bolt = (r < SHANK) | ((r < HEAD) & (z > THICK))
    plate, table = ~bolt & (z > 0.0) & (z < THICK), ~bolt & (z < 0.0)
    held = cells[bolt | table]
    used, numbers = np.unique(held, return_inverse=True)
    fixed = points[used], numbers.reshape(held.shape)
    used, numbers = np.unique(cells[plate], return_inverse=True)
    loose = points[used], numbers.reshape(-1, 8)
    domain = mesh_of(MPI.COMM_SELF, "hexahedron", *concatenated(fixed, loose))
    names = {"bolt": 1, "table": 2, "plate": 3, "cut": 4, "joint": 5, "top of the table": 6}
    names |= {"head": 7, "seat": 8, "bottom": 9, "rim": 10}
    cell_tags = tags_of(domain, [*np.where(bolt, 1, 2)[bolt | table], *np.repeat(3, plate.sum())])
    on = {"joint": (0.0, 3), "head": (THICK, 1), "seat": (THICK, 3), "bottom": (-1.0, 2)}
    markers = [
        (names[k], lambda x, at=at: np.isclose(x[2], at), body) for k, (at, body) in on.items()
    ]
    markers.append((6, lambda x: np.isclose(x[2], 0.0), 2))
    markers.append((10, lambda x: np.isclose(np.abs(x[:2]).max(axis=0), half), 3))
    tags = tag_facets(domain, markers, cell_tags)
    domain.topology.create_connectivity(2, 3)
    cut = locate_entities(
        domain, 2, lambda x: np.isclose(x[2], 0.5) & (np.abs(x[:2]).max(axis=0) < SHANK + 1e-9)
    )
    facets, first = np.unique(np.append(tags.indices, cut), return_index=True)
    values = np.append(tags.values, np.full(cut.size, 4, dtype=np.int32))[first]
    whole = TaggedMesh(domain, cell_tags, meshtags(domain, 2, facets, values), names)
    interface = Interface(("bolt", "bolt"), ("below", "above"), facets="cut")
    parts = split_interfaces(whole, [interface])
    scene = Scene.of(parts)
    scene.fix(names["bottom"])
    load = fem.Constant(parts.mesh, 0.0)
    scene.L = load / (8 * half * THICK) * scene.v[2] * scene.ds(names["rim"])
    given = {"a": scene.a, "L": scene.L, "bcs": scene.bcs, "load": load}
    return given | {"read_msh": lambda path, split: parts}


def preload(scene: Scene, bolt: int = 0, **data: Any) -> BoltPreload:
    """Return the preload of a bolt."""
    return BoltPreload(scene.facet_tags, CUT + 2 * bolt, CUT + 2 * bolt + 1, **data)


def reference_solution(
    scene: Scene, force: float | None, shortening: float = 0.0
) -> tuple[NDArray[np.float64], float, float]:
    """Return displacement, shortening and tension of a single bolt, by elimination of its cut.

    The upper side moves as the lower one, and down by the shortening.
    """
    V = scene.V
    matrix = petsc.assemble_matrix(fem.form(scene.a))
    matrix.assemble()
    indptr, indices, data = matrix.getValuesCSR()
    K = sp.csr_matrix((data, indices, indptr))
    f = np.zeros(K.shape[0])
    if scene.L != 0:
        f = petsc.assemble_vector(fem.form(scene.L)).array.copy()
    rows, contacts = zip(*(reference._rows(V, contact) for contact in scene.contacts), strict=True)
    C, gap = sp.vstack(rows), np.concatenate([contact.gap for contact in contacts])
    upper, lower = (reference.nodes_of(V, scene.facet_tags.find(CUT + k)) for k in range(2))
    x = V.tabulate_dof_coordinates()
    lower = lower[np.linalg.norm(x[upper][:, None] - x[lower], axis=2).argmin(axis=1)]
    # the unknowns of the upper side are those of the lower one, and one more, the shortening
    source = np.arange(K.shape[0])
    for k in range(3):
        source[3 * upper + k] = 3 * lower + k
    T = sp.csr_matrix((np.ones(source.size), (np.arange(source.size), source)))
    down = np.zeros(source.size)
    down[3 * upper + 2] = -1.0
    T = sp.hstack([sp.csr_matrix(T, shape=K.shape), down[:, None]], format="csr")
    prescribed = np.append(reference.prescribed_values(V, scene.bcs), np.nan)
    prescribed[np.setdiff1d(np.arange(source.size), source)] = 0.0
    load = T.T @ f
    if force is None:
        prescribed[-1] = shortening
    else:
        load[-1] += force
    fixed = np.flatnonzero(~np.isnan(prescribed))
    solution = reference.primal_active_set(T.T @ K @ T, load, fixed, prescribed[fixed], C @ T, gap)
    u = T @ solution.displacement
    # the lower part of the bolt is pulled upwards
    tension = float((K @ u - f)[3 * lower + 2].sum())
    return u.reshape(-1, 3), float(solution.displacement[-1]), tension
