"""Make a roller bearing of one or two rows, of hexahedra: rings, rollers and a cage.

    python meshes/roller_bearing.py [--rollers 35] [--rows 2] [--output FILE]

Lengths are in metres; the axis of the bearing is z. The full size has 2 x 35 rollers, an outer
ring, an inner ring and a cage: 73 bodies.

The rollers are crowned cylinders, inclined to the axis (angular contact), so that the bearing
carries radial and axial loads. They run between two cones. The rows are mirror images in z = 0. The
cage is a ring between the rows, with a prong between any two rollers.

Every body is a plane mesh of quadrilaterals, finest at the lines of contact, that is swept along
the rollers. Meshes of rings and rollers do not match. The surfaces of row 1 are "rollers 1 outer",
"rollers 1 inner", "rollers 1 side", "outer raceway 1", "inner raceway 1" and "pockets 1" of the
cage. "outside" is that of the outer ring, "bore" that of the inner one. One sector, with one roller
of each row, has the borders "first border" and, turned about z, "second border".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gmsh
import numpy as np
from gmsh_files import (
    closed,
    command_line,
    ignore_other_sizes,
    name_group,
    new_file,
    session,
    surface,
)
from numpy.typing import NDArray

Points = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Bearing:
    """Dimensions [m] and fineness of the mesh.

    Attributes
    ----------
    rollers, rows : int
        Rollers in a row, and 1 or 2 rows.
    radius, length : float
        Of a roller, the radius in its middle.
    spacing : float
        Distance between neighbouring rollers in the middle of their length.
    angle : float
        Angle between the axes of rollers and bearing [degrees].
    clearance : float
        Play of a roller between the raceways, half of it on either side.
    crowning : float
        By how much the radius is smaller at the ends than in the middle of a roller, as a parabola.
    wall : float
        Smallest thickness of the rings.
    cage : bool
        Whether there is a cage.
    play : float
        Distance between cage and rollers.
    strip : float
        Half-width of the surfaces that may touch, on either side of the line of contact.
    elements : int
        Elements, of equal size, on the half-width of a roller's strip, an even number.
    growth : float
        Growth of the elements with the distance from the line of contact.
    coarsest : float
        Largest element.
    layers : int
        Elements along a roller.
    shortest : float
        Length of the elements at the ends of a roller, relative to that of equal ones.
    """

    rollers: int = 35
    rows: int = 2
    radius: float = 0.036
    length: float = 0.110
    spacing: float = 0.020
    angle: float = 20.0
    clearance: float = 20e-6
    crowning: float = 30e-6
    wall: float = 0.030
    cage: bool = True
    play: float = 1e-3
    strip: float = 1.6e-3
    elements: int = 4
    growth: float = 0.9
    coarsest: float = 0.012
    layers: int = 16
    shortest: float = 0.5

    @property
    def pitch_radius(self) -> float:
        """Distance of a roller's middle from the axis of the bearing [m]."""
        return self.rollers * (2 * self.radius + self.spacing) / (2 * np.pi)

    @property
    def alpha(self) -> float:
        """Angle between the axes of rollers and bearing [rad]."""
        return float(np.radians(self.angle))

    @property
    def directions(self) -> Points:
        """Axis of a roller and the direction to the outer raceway, as (r, z)."""
        c, s = np.cos(self.alpha), np.sin(self.alpha)
        return np.array([[s, c], [c, -s]])

    @property
    def centre(self) -> Points:
        """Middle of a roller of the first row, as (r, z) [m]."""
        reach = 0.5 * self.length * np.cos(self.alpha) + self.radius * np.sin(self.alpha)
        return np.array([self.pitch_radius, reach + 0.12 * self.length])

    @property
    def names(self) -> list[str]:
        """Names of the bodies."""
        rollers = [f"roller {k + 1}" for k in range(self.rows * self.rollers)]
        return ["outer ring", "inner ring", *(["cage"] if self.cage else []), *rollers]

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        return len(self.names)

    def azimuth(self, k: int) -> float:
        """Return the angle of roller k of a row about z; the first one is at -y [rad]."""
        return 2 * np.pi * k / self.rollers - np.pi / 2

    def lines(self, row: int) -> Points:
        """Return middles, axes and directions to the outer raceway of a row, (3, rollers, 3).

        The second row is the mirror image of the first one.
        """
        phi = np.array([self.azimuth(k) for k in range(self.rollers)])
        sign = 1.0 if row == 1 else -1.0
        return np.array(
            [
                np.stack([r * np.cos(phi), r * np.sin(phi), np.full(phi.size, sign * z)], axis=1)
                for r, z in (self.centre, *self.directions)
            ]
        )

    def roller_of(self, x: Points) -> Numbers:
        """Return the number in its row of the roller next to each point x of shape (3, n)."""
        turn = (np.arctan2(x[1], x[0]) - self.azimuth(0)) * self.rollers / (2 * np.pi)
        return np.rint(turn).astype(np.int64) % self.rollers

    def away_from_axis(self, row: int) -> Callable[[Points], Points]:
        """Return the normals of the rollers of a row, a function of x (3, n)."""
        centres, axes, _ = self.lines(row)

        def normal(x: Points) -> Points:
            k = self.roller_of(x)
            across = x.T - centres[k]
            return (across - np.sum(across * axes[k], axis=1)[:, None] * axes[k]).T

        return normal


@dataclass
class Solid:
    """A mesh of hexahedra with tagged facets.

    Attributes
    ----------
    points : (n, 3) array
        Nodes [m].
    cells : (m, 8) integer array
        Their nodes in Gmsh's order.
    facets : dict of str to (k, 4) integer array
        Facets of each surface with a name.
    """

    points: Points
    cells: Numbers
    facets: dict[str, Numbers] = field(default_factory=dict)


# A plane mesh: points (n, 2) and counter-clockwise quadrilaterals (m, 4).
Sheet = tuple[Points, Numbers]


def plane_mesh(
    outline: Callable[[], tuple[list[int], list[int]]], size: Callable[[float, float], float]
) -> Sheet:
    """Mesh surfaces by quadrilaterals; all elements are cut in four, so `size` is theirs twice.

    `outline` makes the surfaces and returns, with the finest curves, the numbers of elements
    before they are cut.
    """
    gmsh.clear()
    for curve, divisions in zip(*outline(), strict=True):
        gmsh.model.mesh.setTransfiniteCurve(curve, divisions + 1)
    gmsh.model.mesh.setSizeCallback(lambda dim, tag, x, y, z, *_: size(x, y))
    gmsh.model.mesh.generate(2)
    tags, points, _ = gmsh.model.mesh.getNodes()
    _, _, rows = gmsh.model.mesh.getElements(2)
    quads = np.searchsorted(np.sort(tags), rows[0].reshape(-1, 4))
    points = points.reshape(-1, 3)[np.argsort(tags), :2]
    used = np.unique(quads)
    return points[used], np.searchsorted(used, quads)


def mirrored(sheet: Sheet, axis: int, place: float = 0.0) -> Sheet:
    """Add the mirror image in x[axis] = place."""
    points, quads = sheet
    image = points.copy()
    image[:, axis] = 2 * place - image[:, axis]
    return merged(np.concatenate([points, image]), [quads, quads[:, ::-1] + len(points)])


def merged(points: Points, cells: Sequence[Numbers], step: float = 1e-7) -> Sheet:
    """Merge nodes at the same place."""
    # no node is half-way between two steps, but for a coincidence
    keys = np.floor(points / step + np.sqrt([2, 3, 5])[: points.shape[1]])
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return points[first], number.ravel()[np.concatenate(cells)]


def roller_sheet(bearing: Bearing) -> Sheet:
    """Mesh the cross-section of a roller, symmetric about both axes; its radius is 1."""
    r, fine = bearing.radius, bearing.strip / bearing.radius
    finest = bearing.strip / bearing.elements

    def outline() -> tuple[list[int], list[int]]:
        geo = gmsh.model.geo
        centre, right = geo.addPoint(0, 0, 0), geo.addPoint(r, 0, 0)
        top = geo.addPoint(0, r, 0)
        end = geo.addPoint(r * np.sin(fine), r * np.cos(fine), 0)
        sides = [geo.addLine(centre, right), geo.addCircleArc(right, centre, end)]
        sides += [geo.addCircleArc(end, centre, top), geo.addLine(top, centre)]
        surface(sides)
        geo.synchronize()
        return [sides[2]], [bearing.elements // 2]

    points, quads = plane_mesh(outline, element_size(bearing, finest, bearing.strip, r))
    points[np.abs(points) < 1e-9] = 0.0
    distance = np.linalg.norm(points, axis=1)
    outside = distance > 0.9999 * r - bearing.coarsest**2 / (8 * r)
    outside &= np.isin(np.arange(len(points)), boundary_edges(quads))
    outside &= (points > 0).all(axis=1) | (np.abs(distance - r) < 1e-9)
    points[outside] *= (r / distance[outside])[:, None]
    return mirrored(mirrored((points / r, quads), 0), 1)


def ring_sheet(bearing: Bearing, thickness: float) -> Sheet:
    """Mesh a sector of a ring, rolled out: the raceway is y = 0; x is divided by the radius."""
    half, w = np.pi * bearing.pitch_radius / bearing.rollers, 1.25 * bearing.strip
    divisions = bearing.elements
    corners = [(0.0, 0.0), (w, 0.0), (half, 0.0), (half, thickness), (0.0, thickness)]

    def outline() -> tuple[list[int], list[int]]:
        geo = gmsh.model.geo
        sides = closed([geo.addPoint(x, y, 0) for x, y in corners])
        surface(sides)
        geo.synchronize()
        return [sides[0]], [divisions // 2]

    points, quads = plane_mesh(outline, element_size(bearing, w / divisions, w, 0.0))
    points, quads = mirrored((points, oriented(points, quads)), 0)
    points[:, 0] /= bearing.pitch_radius
    return points, quads


def element_size(
    bearing: Bearing, finest: float, width: float, height: float
) -> Callable[[float, float], float]:
    """Return the size of elements before they are cut, growing away from the strip of contact."""

    def size(x: float, y: float) -> float:
        away = float(np.hypot(max(0.0, abs(x) - width), y - height))
        return 2 * min(finest + bearing.growth * away, bearing.coarsest)

    return size


def oriented(points: Points, quads: Numbers) -> Numbers:
    """Return the quadrilaterals counter-clockwise."""
    a, b = points[quads[:, 2]] - points[quads[:, 0]], points[quads[:, 3]] - points[quads[:, 1]]
    clockwise = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0
    return np.where(clockwise[:, None], quads[:, ::-1], quads)


def boundary_edges(quads: Numbers) -> Numbers:
    """Return the edges (k, 2) of one quadrilateral only."""
    edges = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, first, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    return edges[first[count == 1]]


def swept(quads: Numbers, nodes: int, layers: Sequence[int] | range) -> Numbers:
    """Return the hexahedra over quadrilaterals; layer k has the nodes from k * nodes on."""
    return np.concatenate(
        [np.concatenate([quads + (k + 1) * nodes, quads + k * nodes], axis=1) for k in layers]
    )


def walls(edges: Numbers, nodes: int, layers: Sequence[int] | range) -> Numbers:
    """Return the facets over edges."""
    a, b = edges.T
    return np.concatenate(
        [np.stack([a, b, b + nodes, a + nodes], axis=1) + k * nodes for k in layers]
    )


def along_roller(bearing: Bearing, layers: int) -> Points:
    """Divide [-1, 1], more finely towards the ends."""
    s = np.linspace(-1, 1, layers + 1)
    a = 1 - bearing.shortest
    return s + a * np.sin(np.pi * s) / np.pi


def roller(bearing: Bearing) -> Solid:
    """Mesh a roller at the azimuth 0 of the first row."""
    sheet, quads = roller_sheet(bearing)
    n, xi = len(sheet), along_roller(bearing, bearing.layers)
    radius = bearing.radius - bearing.clearance / 2 - bearing.crowning * xi**2
    x, y = radius[:, None] * sheet[:, 0], radius[:, None] * sheet[:, 1]
    r, z = meridian(bearing, 0.5 * bearing.length * xi[:, None], y)
    edges = boundary_edges(quads)
    edges = edges[np.linalg.norm(sheet[edges], axis=2).min(axis=1) > 0.999]
    middle, height = sheet[edges].mean(axis=1).T
    every, strip = range(bearing.layers), np.abs(middle) < np.sin(bearing.strip / bearing.radius)
    facets = {
        "rollers outer": walls(edges[strip & (height > 0)], n, every),
        "rollers inner": walls(edges[strip & (height < 0)], n, every),
    }
    if bearing.cage:
        facets["rollers side"] = walls(edges[np.abs(height) < 0.35], n, every)
    return Solid(np.stack([r, x, z], axis=-1).reshape(-1, 3), swept(quads, n, every), facets)


def meridian(bearing: Bearing, along: Points, across: Points) -> tuple[Points, Points]:
    """Return r and z of points given by their coordinates along and across a roller's axis."""
    (ar, az), (br, bz) = bearing.directions
    r, z = bearing.centre
    return r + ar * along + br * across, z + az * along + bz * across


def along_ring(bearing: Bearing, side: int) -> Points:
    """Divide the raceway of the outer (side 1) or inner ring (-1), as positions along a roller."""
    # from the plane between the rows to some way beyond the rollers
    (_, az), (_, bz) = bearing.directions
    start = -(bearing.centre[1] + bz * side * bearing.radius) / az
    half = bearing.length / 2
    inside = half * along_roller(bearing, bearing.layers + 1)
    step = 2 * bearing.length / bearing.layers
    before = np.linspace(start, -half, max(2, round((-half - start) / step)) + 1)
    after = np.linspace(half, 1.25 * half, 2)
    return np.concatenate([before[:-1], inside, after[1:]])


def ring(bearing: Bearing, side: int) -> Solid:
    """Mesh a sector of the outer (side 1) or inner ring (-1): layers from raceway to cylinder."""
    across, half = side * bearing.radius, bearing.length / 2
    along = along_ring(bearing, side)
    r, z = meridian(bearing, along, np.full(along.size, across))
    cylinder = r.max() + bearing.wall if side > 0 else r.min() - bearing.wall
    thickness = abs(cylinder - bearing.pitch_radius - side * bearing.radius)
    sheet, quads = ring_sheet(bearing, thickness)
    n, eta = len(sheet), sheet[:, 1] / thickness
    points = around(sheet[:, 0], (1 - eta) * r[:, None] + eta * cylinder, z[:, None])
    # the inner ring is below its raceway: the sheet is seen from the other side
    quads = quads if side > 0 else quads[:, ::-1]
    edges = boundary_edges(quads)
    x, y = np.abs(sheet[edges][:, :, 0]).max(axis=1), sheet[edges][:, :, 1].mean(axis=1)
    near = (y < 1e-9) & (x < 3 * bearing.strip / bearing.pitch_radius)
    touched = np.flatnonzero(np.abs(along[:-1] + along[1:]) < 2.4 * half)
    name, far = ("outer", "outside") if side > 0 else ("inner", "bore")
    facets = {
        f"{name} raceway": walls(edges[near], n, touched),
        far: walls(edges[y > thickness - 1e-9], n, range(along.size - 1)),
    }
    end = np.pi / bearing.rollers - 1e-9
    for border, sign in (("first border", -1), ("second border", 1)):
        there = (sign * sheet[edges][:, :, 0]).min(axis=1) > end
        facets[border] = walls(edges[there], n, range(along.size - 1))
    return Solid(points, swept(quads, n, range(along.size - 1)), facets)


def cage(bearing: Bearing) -> Solid:
    """Mesh a sector of the cage, a half prong on either side of the roller."""
    side = bearing.radius + bearing.play
    # x is 1 at the pocket and 2 in the middle of a prong
    x = np.concatenate([np.linspace(0, 1, 4), np.linspace(1, 2, 3)[1:]])
    y = 0.4 * bearing.radius * np.linspace(-1, 1, 4)
    sheet = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    m = y.size
    corner = (np.arange(x.size - 1)[:, None] * m + np.arange(m - 1)).ravel()
    quads = np.stack([corner, corner + m, corner + m + 1, corner + 1], axis=1)
    sheet, quads = mirrored((sheet, quads), 0)
    n = len(sheet)
    # from the plane between the rows to the ends of the rollers, and on between them
    (_, az), (_, bz) = bearing.directions
    plane = -(bearing.centre[1] + bz * sheet[:, 1]) / az
    start, end = -0.53 * bearing.length, 0.4 * bearing.length
    part = np.linspace(0, 1, 3)[:, None]
    prongs = np.linspace(start, end, max(3, bearing.layers // 2) + 1)[1:, None]
    along = np.concatenate([(1 - part) * plane + part * start, np.repeat(prongs, n, axis=1)])
    r, z = meridian(bearing, along, sheet[:, 1])
    edge = r * np.tan(np.pi / bearing.rollers)
    u = np.abs(sheet[:, 0])
    width = np.where(u <= 1, u * side, (2 - u) * side + (u - 1) * edge)
    points = np.stack([r, np.sign(sheet[:, 0]) * width, z], axis=-1).reshape(-1, 3)
    prong = np.abs(sheet[quads].mean(axis=1)[:, 0]) > 1
    edges = boundary_edges(quads[prong])
    at_side = edges[np.abs(np.abs(sheet[edges][:, :, 0]) - 1).max(axis=1) < 1e-9]
    layers = range(2, len(along) - 1)
    cells = [swept(quads, n, range(2)), swept(quads[prong], n, layers)]
    return Solid(points, np.concatenate(cells), {"pockets": walls(at_side, n, layers)})


def around(phi: Points, radius: Points, z: Points) -> Points:
    """Return points of cylindrical coordinates, for all layers (k, n) or (k, 1)."""
    parts = np.broadcast_arrays(radius * np.cos(phi), radius * np.sin(phi), z)
    return np.stack(parts, axis=-1).reshape(-1, 3)


def turned(solid: Solid, angle: float) -> Solid:
    """Turn about the axis."""
    c, s = np.cos(angle), np.sin(angle)
    points = solid.points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return replace(solid, points=points)


UNNUMBERED = ("outside", "bore", "first border", "second border")


def in_row(solid: Solid, row: int) -> Solid:
    """Put a solid into its row, and add the row's number to the names of its surfaces."""
    points, cells = solid.points, solid.cells
    if row == 1:
        points, cells = points * [1, 1, -1], cells[:, [4, 5, 6, 7, 0, 1, 2, 3]]
    facets = {
        name if name in UNNUMBERED else numbered(name, row + 1): rows
        for name, rows in solid.facets.items()
    }
    return Solid(points, cells, facets)


def numbered(name: str, row: int) -> str:
    """Return "rollers 1 outer" for "rollers outer", "outer raceway 1" for "outer raceway"."""
    first, _, last = name.partition(" ")
    return f"rollers {row} {last}" if first == "rollers" else f"{name} {row}"


def joined(solids: Sequence[Solid]) -> Solid:
    """Join parts of a body that share nodes."""
    starts = np.cumsum([0, *(len(solid.points) for solid in solids)])
    names = sorted({name for solid in solids for name in solid.facets})
    shifted = [solid.cells + start for solid, start in zip(solids, starts, strict=False)]
    points, cells = merged(np.concatenate([solid.points for solid in solids]), shifted)
    used = np.unique(cells)
    # the same merging once more, for the facets of each surface
    every = np.concatenate([solid.points for solid in solids])
    facets = {
        name: np.concatenate(
            [s.facets[name] + k for s, k in zip(solids, starts, strict=False) if name in s.facets]
        )
        for name in names
    }
    facets = {name: merged(every, [rows])[1] for name, rows in facets.items()}
    return Solid(
        points[used],
        np.searchsorted(used, cells),
        {name: np.searchsorted(used, rows) for name, rows in facets.items()},
    )


def solids_of(bearing: Bearing, sector: bool = False) -> dict[str, Solid]:
    """Mesh all bodies, or their parts in the first sector, by name."""
    with session():
        for option, value in (
            ("RecombineAll", 1),
            ("RecombinationAlgorithm", 0),
            ("SubdivisionAlgorithm", 1),
        ):
            gmsh.option.setNumber(f"Mesh.{option}", value)
        ignore_other_sizes()
        sectors = {"outer ring": ring(bearing, 1), "inner ring": ring(bearing, -1)}
        one = roller(bearing)
    if bearing.cage:
        sectors["cage"] = cage(bearing)
    number_of_sectors = 1 if sector else bearing.rollers
    places = [(row, k) for row in range(bearing.rows) for k in range(number_of_sectors)]
    if not sector:
        for solid in sectors.values():
            solid.facets = {n: f for n, f in solid.facets.items() if "border" not in n}
    bodies = {
        name: joined([in_row(turned(s, bearing.azimuth(k)), row) for row, k in places])
        for name, s in sectors.items()
    }
    for number, (row, k) in enumerate(places, start=1):
        bodies[f"roller {number}"] = in_row(turned(one, bearing.azimuth(k)), row)
    return bodies


def write(bodies: dict[str, Solid], output: Path) -> None:
    """Write bodies and named surfaces."""
    with new_file(output):
        nodes, elements = 1, 1
        groups: dict[str, list[int]] = {}

        def add(dim: int, kind: int, rows: Numbers, points: Points | None = None) -> int:
            """Make an entity of elements, after those of others."""
            nonlocal elements
            entity = int(gmsh.model.addDiscreteEntity(dim))
            if points is not None:
                gmsh.model.mesh.addNodes(
                    dim, entity, np.arange(len(points)) + nodes, points.ravel()
                )
            numbers = np.arange(len(rows)) + elements
            gmsh.model.mesh.addElementsByType(entity, kind, numbers, (rows + nodes).ravel())
            elements += len(rows)
            return entity

        for name, solid in bodies.items():
            name_group(3, [add(3, 5, solid.cells, solid.points)], name)
            for side, rows in solid.facets.items():
                groups.setdefault(side, []).append(add(2, 3, rows))
            nodes += len(solid.points)
        for side, entities in groups.items():
            name_group(2, entities, side)
        gmsh.option.setNumber("Mesh.Binary", 1)


def subdomain_labels(
    bearing: Bearing, cells: Mapping[str, Numbers], x: Points, slices: int
) -> Numbers:
    """Cut all bodies equally in all sectors, so that subdomains are images of each other.

    Parameters
    ----------
    bearing : Bearing
        Dimensions.
    cells : dict of str to integer arrays
        The cells of the bodies, by name; those beyond the points are left out.
    x : (n, 3) array
        Midpoints of cells [m].
    slices : int
        Number of slices of a roller, and of a sector of a ring with a roller of one row.

    Returns
    -------
    (n,) integer array
        Labels of the cells, which repeat from body to body; the cage has one for seven sectors,
        or for each.
    """
    labels = np.zeros(len(x), dtype=np.int64)
    for body, all_of_them in cells.items():
        own = all_of_them[all_of_them < len(x)]
        labels[own] = _labels_of_body(bearing, body, x[own], slices)
    return labels


def _labels_of_body(bearing: Bearing, body: str, x: Points, slices: int) -> Numbers:
    sector = bearing.roller_of(x.T)
    row = (x[:, 2] < 0).astype(np.int64)
    layer, layers = np.zeros(len(x), dtype=np.int64), 1
    if body == "cage":
        sector //= 7 if bearing.rollers % 7 == 0 else 1
    elif body.startswith("roller"):
        mirrored = x * [1.0, 1.0, -1.0]
        centres, axes, _ = bearing.lines(1)
        first = np.where(row[:, None] == 0, x, mirrored)
        place = np.sum((first - centres[sector]) * axes[sector], axis=1)
        ends = 0.5 * bearing.length * along_roller(bearing, bearing.layers)
        layer, layers = np.searchsorted(ends, place) - 1, ends.size - 1
    else:
        side = 1 if body == "outer ring" else -1
        along = along_ring(bearing, side)
        _, ends = meridian(bearing, along, np.full(along.size, side * bearing.radius))
        layer, layers = np.searchsorted(ends, np.abs(x[:, 2])) - 1, ends.size - 1
    piece = np.clip(layer, 0, layers - 1) * slices // layers
    return (row * bearing.rollers + sector) * slices + piece


def small_bearing() -> Bearing:
    """Return a bearing of two rows of 8 rollers without cage, of coarse elements."""
    return Bearing(rollers=8, cage=False, elements=2, growth=1.0, coarsest=0.025, layers=6)


def roller_bearing(output: Path, bearing: Bearing, sector: bool = False) -> None:
    """Mesh the bearing, or one sector of it, and write the file."""
    write(solids_of(bearing, sector), output)


def with_dimensions(output: Path, **dimensions: Any) -> None:
    """Mesh the bearing of some dimensions and write the file."""
    roller_bearing(output, Bearing(**dimensions))


if __name__ == "__main__":
    command_line(with_dimensions, options_of=Bearing)
