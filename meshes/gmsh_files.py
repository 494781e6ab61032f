"""What the scripts of this folder share: files, names and sizes by Gmsh, and the command line.

The scripts need Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
"""

from __future__ import annotations

import argparse
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import gmsh
import numpy as np

# cell: dimension, Gmsh's numbers of the cell and of its facets, the nodes of its facets
CELLS = {
    "triangle": (2, 2, 1, [[0, 1], [1, 2], [2, 0]]),
    "quadrilateral": (2, 3, 1, [[0, 1], [1, 2], [2, 3], [3, 0]]),
    "tetrahedron": (3, 4, 2, [[0, 1, 2], [0, 1, 3], [1, 2, 3], [0, 2, 3]]),
    "hexahedron": (
        3,
        5,
        3,
        [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]],
    ),
}
# Gmsh's order of the corners of a quadrilateral and a hexahedron, as steps along the axes
CORNERS = {
    2: [(0, 0), (1, 0), (1, 1), (0, 1)],
    3: [
        (0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)
    ],
}  # fmt: skip


# -- sessions and the command line ---------------------------------------------------------------


@contextmanager
def session() -> Iterator[None]:
    """Open Gmsh without terminal output, and close it."""
    gmsh.initialize(readConfigFiles=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        yield
    finally:
        gmsh.finalize()


@contextmanager
def new_file(output: Path) -> Iterator[None]:
    """Open a new model, and write its mesh to a file in the end."""
    with session():
        gmsh.model.add(output.stem)
        yield
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))


def command_line(make: Callable[..., None], options_of: Callable[..., Any] | None = None) -> None:
    """Call a function that makes a file with what the command line gives.

    There is an option for each argument of the function, or of `options_of`, and `--output`, by
    default the file beside the script that has its name.
    """
    script, source = sys.modules["__main__"], options_of or make
    parser = argparse.ArgumentParser(description=(script.__doc__ or "").splitlines()[0])
    for name, argument in inspect.signature(source, eval_str=True).parameters.items():
        default = argument.default
        if name == "output":
            continue
        given: dict[str, Any] = {"default": default, "help": f"default: {default}"}
        if isinstance(default, bool):
            given["action"] = argparse.BooleanOptionalAction
        elif isinstance(default, tuple):
            given |= {"type": type(default[0]), "nargs": "+"}
        else:
            given |= {"type": type(default), "choices": get_args(argument.annotation) or None}
        parser.add_argument(f"--{name.replace('_', '-')}", **given)
    output = Path(str(script.__file__)).with_suffix(".msh")
    parser.add_argument("--output", type=Path, default=output, help=f"default: {output.name}")
    make(**vars(parser.parse_args()))


# -- entities and sizes --------------------------------------------------------------------------


def name_group(dim: int, entities: Sequence[int], name: str, tag: int = -1) -> None:
    """Make a physical group with a name, by default with the next tag."""
    gmsh.model.setPhysicalName(dim, gmsh.model.addPhysicalGroup(dim, entities, tag), name)


def circle(x: float, y: float, radius: float, size: float) -> list[int]:
    """Make a circle of four arcs."""
    geo = gmsh.model.geo
    centre = geo.addPoint(x, y, 0)
    places = [(x + radius, y), (x, y + radius), (x - radius, y), (x, y - radius)]
    points = [geo.addPoint(*place, 0, size) for place in places]
    ends = points[1:] + points[:1]
    return [geo.addCircleArc(a, centre, b) for a, b in zip(points, ends, strict=True)]


def closed(points: Sequence[int]) -> list[int]:
    """Join points by lines, the last one with the first one."""
    pairs = zip(points, [*points[1:], points[0]], strict=True)
    return [gmsh.model.geo.addLine(a, b) for a, b in pairs]


def surface(*loops: Sequence[int]) -> int:
    """Make the plane surface within a loop of curves, without those of further loops."""
    geo = gmsh.model.geo
    return int(geo.addPlaneSurface([geo.addCurveLoop(curves, reorient=True) for curves in loops]))


def sides_of(solid: int) -> list[int]:
    """Return the surfaces around a volume."""
    return [tag for _, tag in gmsh.model.getBoundary([(3, solid)], oriented=False)]


def set_size(size: Callable[..., float]) -> None:
    """Let a function of (dim, tag, x, y, z, size) alone decide the size of elements."""
    gmsh.model.mesh.setSizeCallback(size)
    ignore_other_sizes()


def set_size_formula(formula: str) -> None:
    """Let the size of elements follow a formula of x, y, z, beside what else limits it."""
    field = gmsh.model.mesh.field.add("MathEval")
    gmsh.model.mesh.field.setString(field, "F", formula)
    gmsh.model.mesh.field.setAsBackgroundMesh(field)


def ignore_other_sizes() -> None:
    """Take the sizes of elements from no points, curves or boundaries."""
    for source in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
        gmsh.option.setNumber(f"Mesh.MeshSize{source}", 0)


def graded(start: float, end: float, finest: float, coarsest: float, growth: float) -> list[float]:
    """Divide an interval, finely at its ends, symmetric about its middle; its ends are left out."""
    half, step = (end - start) / 2, finest
    distances = [0.0]
    while distances[-1] < half:
        distances.append(distances[-1] + step)
        step = min(growth * step, coarsest)
    distances = [half * distance / distances[-1] for distance in distances[1:]]
    first = [start + distance for distance in distances]
    return first + [end - distance for distance in reversed(distances[:-1])]


def mesh_with_hexahedra(elements: int) -> None:
    """Cut each cube into a regular grid of so many elements along each edge."""
    mesh = gmsh.model.mesh
    for _, curve in gmsh.model.getEntities(1):
        mesh.setTransfiniteCurve(curve, elements + 1)
    for _, side in gmsh.model.getEntities(2):
        mesh.setTransfiniteSurface(side)
        mesh.setRecombine(2, side)
    for _, volume in gmsh.model.getEntities(3):
        mesh.setTransfiniteVolume(volume)
    mesh.generate(3)


def round_coordinates() -> None:
    """Round to a nanometre: shorter files."""
    for dim, entity in gmsh.model.getEntities():
        nodes, points, _ = gmsh.model.mesh.getNodes(dim, entity)
        for node, point in zip(nodes, np.reshape(points, (-1, 3)), strict=True):
            gmsh.model.mesh.setNode(int(node), list(np.round(point, 9)), [])


# -- meshes that are made of arrays --------------------------------------------------------------


def brick(axes: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (n, gdim) of a grid, and its cells as rows of nodes."""
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    number = np.arange(nodes[..., 0].size).reshape(nodes.shape[:-1])
    cells = [
        number[tuple(slice(s, n - 1 + s) for s, n in zip(corner, number.shape, strict=True))]
        for corner in CORNERS[len(axes)]
    ]
    return nodes.reshape(-1, len(axes)), np.stack(cells, axis=-1).reshape(-1, len(cells))


def joined(
    parts: Sequence[tuple[np.ndarray, np.ndarray]], step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Join grids; nodes whose columns agree to some steps are one."""
    starts = np.cumsum([0] + [len(nodes) for nodes, _ in parts[:-1]])
    nodes = np.concatenate([part for part, _ in parts])
    cells = np.concatenate([rows + start for (_, rows), start in zip(parts, starts, strict=True)])
    rounded = np.round(nodes / step, 6)
    _, first, place = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return nodes[first], place.ravel()[cells]


def boundary_facets(cells: np.ndarray, sides: Sequence[Sequence[int]]) -> np.ndarray:
    """Return the facets of one cell only, as rows of nodes; `sides` are those of a cell."""
    facets = np.concatenate([cells[:, side] for side in sides])
    _, first, count = np.unique(
        np.sort(facets, axis=1), axis=0, return_index=True, return_counts=True
    )
    return facets[first[count == 1]]


def write(
    output: Path,
    cell: str,
    points: np.ndarray,
    bodies: Mapping[str, np.ndarray],
    groups: Mapping[str, np.ndarray],
) -> None:
    """Write cells and facets, both by name, as physical groups numbered 1, 2, ... in this order."""
    gdim, cell_type, facet_type, _ = CELLS[cell]
    with new_file(output):
        mesh, tag = gmsh.model.mesh, 0
        for dim, kind, named in ((gdim, cell_type, bodies), (gdim - 1, facet_type, groups)):
            for name, rows in named.items():
                tag += 1
                gmsh.model.addDiscreteEntity(dim, tag)
                if tag == 1:
                    numbers, xyz = np.arange(len(points)) + 1, np.zeros((len(points), 3))
                    xyz[:, :gdim] = points
                    mesh.addNodes(gdim, 1, numbers, xyz.ravel())
                mesh.addElementsByType(tag, kind, [], (rows + 1).ravel())
                name_group(dim, [tag], name, tag)
