"""Draw a deformed mesh in a process of its own: ``python _render.py data.npz picture.png``.

VTK of PyPI 9.7 aborts beside Debian 12's dolfinx 0.5.2 where it draws a colour bar, and with other
versions where there is no off-screen rendering. In a process of its own this costs the picture and
not the solution. The script is run by its path and imports nothing of its package; `pictures.py`
writes the data.
"""

from __future__ import annotations

import sys
import textwrap
from typing import Any

import numpy as np
import pyvista
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

Image = NDArray[np.uint8]

INK = "#22262b"
OUTLINE = "#8a9099"
OBSTACLE = "#c3c8ce"
DPI = 200


def build_surface(data: Any) -> pyvista.PolyData:
    """Return the undeformed outer faces, or those of the bodies as cut, with their colours."""
    faces = data["faces"]
    if "section" not in data:
        rows = np.column_stack([np.full(len(faces), faces.shape[1]), faces])
        return with_fields(pyvista.PolyData(data["points"], rows.ravel()), data)
    is_tetrahedron = faces.shape[1] == 4
    kind = pyvista.CellType.TETRA if is_tetrahedron else pyvista.CellType.HEXAHEDRON
    around = faces if is_tetrahedron else faces[:, [0, 1, 3, 2, 4, 5, 7, 6]]
    cells = with_fields(pyvista.UnstructuredGrid({kind: around}, data["points"]), data)
    point, normal = data["section"]
    outside = cells.extract_surface().clip(normal=normal, origin=point)
    return outside.append_polydata(cells.slice(normal=normal, origin=point))


def with_fields(surface: pyvista.DataSet, data: Any) -> pyvista.DataSet:
    """Add the colours and the displacement to a mesh."""
    colours = data["colours"]
    target = surface.point_data if colours.ndim == 1 else surface.cell_data
    target["colours"] = colours.ravel()
    surface.point_data["displacement"] = data["displacement"]
    return surface


def sharp_edges(surface: pyvista.PolyData) -> pyvista.PolyData:
    """Return the sharp edges and the boundary of each body.

    The filter merges points at the same place; bodies that touch are moved apart for it.
    """
    surface.point_data["place"] = surface.points
    bodies = surface.connectivity("all")
    apart = 2 * bodies.length * bodies.point_data["RegionId"]
    bodies.points = bodies.points + np.outer(apart, [1.0, 0.0, 0.0])
    edges = bodies.extract_feature_edges(
        feature_angle=30, boundary_edges=True, manifold_edges=False, non_manifold_edges=False
    )
    if edges.n_points:
        edges.points = edges.point_data["place"]
    return edges


def obstacle_shape(gaps: NDArray[np.float64], axes: NDArray[np.float64]) -> pyvista.DataSet:
    """Return the part of a plane grid within an obstacle, or the obstacle's surface in space."""
    x, y, z = axes.T
    grid = pyvista.RectilinearGrid(x, y, z[:1] if gaps.shape[2] == 1 else z)
    grid["gap"] = gaps.ravel(order="F")
    if gaps.shape[2] == 1:
        return grid.clip_scalar("gap", value=0.0)
    return grid.contour([0.0], "gap")


def render_mesh(data: Any, limits: tuple[float, float], pixels: tuple[int, int]) -> Image:
    """Return an image (height, width, 3) of the deformed mesh on white, without margins."""
    most_outlined = 20_000  # the lines between more faces would hide the colours
    surface = build_surface(data)
    edges = sharp_edges(surface)
    deformed, deformed_edges = (part.copy() for part in (surface, edges))
    for part in (deformed, deformed_edges):
        part.points = part.points + float(data["scale"]) * part["displacement"]

    plotter = pyvista.Plotter(off_screen=True, window_size=list(pixels), lighting="none")
    plotter.add_light(pyvista.Light((0, 0.5, 1), light_type="camera light"))
    plotter.set_background("white")
    plotter.enable_anti_aliasing("ssaa")
    plotter.add_mesh(
        deformed,
        scalars="colours",
        cmap=str(data["colour_map"]),
        clim=limits,
        show_scalar_bar=False,
        show_edges=deformed.n_cells < most_outlined,
        edge_color=INK,
        edge_opacity=0.3,
        line_width=1.5,
        ambient=0.78,
        diffuse=0.28,
        specular=0,
    )
    if edges.n_points:
        plotter.add_mesh(edges, color=OUTLINE, line_width=2.5, lighting=False)
        plotter.add_mesh(deformed_edges, color=INK, line_width=3.5, lighting=False)
    number = 0
    while f"gaps {number}" in data:
        shape = obstacle_shape(data[f"gaps {number}"], data[f"axes {number}"])
        if shape.n_points:
            plotter.add_mesh(
                shape, color=OBSTACLE, opacity=0.5, lighting=False, show_scalar_bar=False
            )
        number += 1
    if np.ptp(data["points"][:, 2]) == 0:
        plotter.view_xy()
        plotter.enable_parallel_projection()
    else:
        plotter.view_vector(data["camera"], viewup=(0, 0, 1))
        plotter.camera.view_angle = 24
    plotter.reset_camera()
    image: Image = plotter.screenshot(None, return_img=True)
    plotter.close()
    return without_margins(image)


def without_margins(image: Image) -> Image:
    """Remove the white rows and columns around the drawing."""
    drawn = np.any(image < 250, axis=2)
    rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
    return image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def compose(data: Any, image: Image, limits: tuple[float, float], path: str) -> None:
    """Compose the title, the image, the colour bar and the note into one picture."""
    width, height = data["size"] / DPI
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.04, 0.95, str(data["title"]), fontsize=13, color=INK, va="top")
    figure.text(0.04, 0.04, str(data["note"]), fontsize=8, color=OUTLINE, va="bottom")
    # up to the label of the colour bar, and below the title
    axes = figure.add_axes((0.03, 0.09, 0.78, 0.78 if str(data["title"]) else 0.88))
    axes.imshow(image, interpolation="lanczos")
    axes.set_axis_off()
    bar_axes = figure.add_axes((0.885, 0.16, 0.018, 0.6))
    mappable = ScalarMappable(Normalize(*limits), str(data["colour_map"]))
    extend = "max" if bool(data["exceeded"]) else "neither"
    bar = figure.colorbar(mappable, cax=bar_axes, extend=extend)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, colors=INK, length=2)
    label = textwrap.fill(str(data["label"]), 14)
    bar_axes.set_title(label, fontsize=9, color=INK, pad=10, loc="center")
    figure.savefig(path)


def main(data_path: str, picture_path: str) -> None:
    """Draw the picture."""
    with np.load(data_path) as file:
        data = dict(file)
    low, high = data["limits"]
    if high - low <= 1e-12 * max(abs(low), abs(high)):  # the colour bar needs an interval
        low, high = low - 0.5 * (abs(low) or 1), high + 0.5 * (abs(high) or 1)
    limits = (float(low), float(high))
    image = render_mesh(data, limits, (2 * int(data["size"][0]), 2 * int(data["size"][1])))
    compose(data, image, limits, picture_path)


if __name__ == "__main__":
    main(*sys.argv[1:])
