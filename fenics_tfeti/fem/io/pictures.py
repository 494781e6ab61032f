"""Pictures of solutions in PNG files, made without a display."""

from __future__ import annotations

import importlib.util
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError, check_value
from fenics_tfeti.fem.contact.descriptions.shapes import Obstacle
from fenics_tfeti.fem.io.scene import Scene, gather_scene
from fenics_tfeti.fem.io.units import UnitSystem, units_of
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.user_data import is_number
from fenics_tfeti.feti.files.arrays import folder_of, write_arrays, write_whole
from fenics_tfeti.parallel import (
    concatenate_ranks,
    meet,
    raise_collectively,
    warn_on_first_rank,
)
from fenics_tfeti.typing import Vector

_log = logging.getLogger(__name__)

_RENDER = Path(__file__).with_name("_render.py")
# largest value in MPa or GPa below which stresses in MPa may have been taken for some in Pa
_TINY = 1e-2


def draw_deformed(
    path: str | os.PathLike[str],
    displacement: Function,
    colour: Function | None = None,
    *,
    label: str | None = None,
    unit: str = "",
    units: UnitSystem = "SI",
    title: str = "",
    scale: float | None = None,
    obstacles: Sequence[Obstacle] = (),
    cells: Any | None = None,
    section: Sequence[Sequence[float]] | None = None,
    camera: Sequence[float] = (-0.6, -1.0, 0.55),
    colour_map: str = "YlOrRd",
    limits: tuple[float, float] | None = None,
    size: tuple[int, int] = (1600, 1000),
) -> None:
    """Draw the deformed mesh, coloured by a field, and the undeformed outline. Collective.

    Under MPI, rank 0 gathers the outer faces and draws them. Faces of degree 2, and those of fields
    of degree 2, are drawn as the pieces into which their nodes cut them.

    Parameters
    ----------
    path : path-like
        The .png file. Its folder is created if it does not exist.
    displacement : dolfinx.fem.Function
        Continuous of degree 1 or 2, with one component for each dimension of the mesh [m].
    colour : dolfinx.fem.Function, optional
        A scalar, continuous of degree 1 or 2 or constant on each cell. By default the magnitude of
        the displacement.
    label : str, optional
        Title of the colour bar; by default the name of `colour`.
    unit : str
        Unit of the colour bar, to which values are converted: m, mm, µm, Pa, kPa, MPa, GPa, N, kN
        or MN. By default values are not converted.
    units : {"SI", "mm-N-MPa"}
        The units that mesh and field have.
    title : str
        Title of the picture.
    scale : float, optional
        Magnification of the displacements, which is written in the picture. By default 1, 2 or 5
        times a power of ten, such that the largest displacement is drawn no larger than a tenth of
        the mesh, and 1 where it is larger.
    obstacles : sequence of callables
        Rigid obstacles as those of `RigidObstacle`, drawn in grey where they are, as far as the
        bodies reach.
    cells : array of int, optional
        Local numbers of the cells to draw, by default all. Without one of two bodies that touch, as
        in ``cell_tags.find(2)``, the contact surface of the other one is seen.
    section : pair of 3 floats each, optional
        A point of a plane and its normal: the undeformed bodies are cut by the plane, and what the
        normal points to is left out. In three dimensions; cells have straight edges there.
    camera : sequence of 3 floats
        Direction from the mesh to the viewer; the z axis points up. In two dimensions the view
        is along the z axis.
    colour_map : str
        A colour map of Matplotlib.
    limits : tuple of 2 floats, optional
        What the ends of the colour bar stand for, in its unit; values beyond have the colours of
        the ends. By default the lower end is the least value, and the upper one is that which
        0.5 % of the values above the least exceed, if the largest value is more than 1.25 times as
        far from the least: a singular cell does not make all else pale. The largest value is
        written below then. Pictures of one animation should have the same limits.
    size : tuple of int
        Width and height [pixels].

    Raises
    ------
    InputError
        If an argument is wrong.
    ImportError
        If PyVista is missing.
    RuntimeError
        If drawing fails. All errors are raised on all ranks.

    Notes
    -----
    The picture is drawn by another Python process: where VTK fails, the solution is not lost.

    Examples
    --------
    >>> draw_deformed("bodies.png", uh, stress, label="von Mises", unit="MPa")  # doctest: +SKIP
    """
    path = Path(path)
    comm = displacement.function_space.mesh.comm
    meet(comm, "draw_deformed()")
    with raise_collectively(comm):
        _check_path(path)
        factor = units_of(units).factor(unit)
        _check_limits(limits)
        _check_section(section, displacement)
        if comm.rank == 0:
            _require("pyvista")
    fields = [] if colour is None else [colour]
    numbers = None if cells is None else np.asarray(cells, dtype=np.int64)
    scene = gather_scene(displacement, fields, numbers, section is not None)
    low, most, high = factor * _range(displacement if colour is None else colour)
    if limits is None:
        _look_at_unit(comm, max(abs(low), abs(high)), unit, units)
    low, most = (low, most) if limits is None else limits
    with raise_collectively(comm):
        if scene is not None:
            scale = scene.scale if scale is None else scale
            name, values = list(scene.fields.items())[-1]
            name = label or name.replace("_", " ")
            data = {
                "points": scene.points,
                "displacement": scene.displacement,
                "faces": scene.faces,
                "colours": values * factor,
                "limits": np.array([low, most], dtype=float),
                "exceeded": high > most,
                "scale": scale,
                "title": title,
                "label": f"{name} [{unit}]" if unit else name,
                "note": _note(scale, f"{high:.3g} {unit}".rstrip() if high > most else ""),
                "camera": np.asarray(camera, dtype=float),
                "colour_map": colour_map,
                "size": np.asarray(size),
            }
            if section is not None:
                data["section"] = np.asarray(section, dtype=float)
            for number, obstacle in enumerate(obstacles):
                data |= _sampled(obstacle, number, scene, scale)
            _render(path, data)


def _look_at_unit(comm: MPI.Intracomm, largest: float, unit: str, units: UnitSystem) -> None:
    """Warn if pressures in SI units are tiny in the unit of the picture. Collective."""
    if units == "SI" and unit in ("MPa", "GPa") and 0.0 < largest < _TINY:
        warn_on_first_rank(
            comm,
            f"draw_deformed: the largest value is {largest:.2g} {unit}, if the model is in m, N "
            "and Pa; if it is in mm, N and MPa, pass units='mm-N-MPa'",
        )


def _sampled(obstacle: Obstacle, number: int, scene: Scene, scale: float) -> dict[str, Vector]:
    """Return the gaps to an obstacle on a grid around the bodies, and the grid's axes."""
    points = np.concatenate([scene.points, scene.points + scale * scene.displacement])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.05 * np.max(high - low)
    axes = np.linspace(low - margin, high + margin, 400 if scene.flat else 60)
    x, y, z = axes.T
    grid = np.stack(np.meshgrid(x, y, [0.0] if scene.flat else z, indexing="ij"))
    found = obstacle(grid.reshape(3, -1))
    gap = np.asarray(found[0] if isinstance(found, tuple) else found, dtype=float)
    # where there is no obstacle the gap is infinite, which VTK cannot interpolate
    gap = np.where(np.isfinite(gap), gap, np.max(gap, initial=0.0, where=np.isfinite(gap)))
    return {f"gaps {number}": gap.reshape(grid.shape[1:]), f"axes {number}": axes}


def _note(scale: float, largest: str) -> str:
    """Return what stands below a picture."""
    return f"displacements × {scale:g}; grey lines: undeformed" + (
        f"; the largest value is {largest}" if largest else ""
    )


def _range(field: Function) -> Vector:
    """Return three values of a scalar, or sizes of a vector. Collective.

    They are the least one, that which few of the values above the least exceed, and the largest.
    """
    share, much = 0.995, 1.25  # of values below the upper end; the largest one is much larger
    nodes = NodeMap(field.function_space)
    rows = nodes.values(field)[: nodes.owned]
    values = rows.ravel() if rows.shape[1] == 1 else np.linalg.norm(rows, axis=1)
    values = concatenate_ranks(field.function_space.mesh.comm, values)
    low, high = values.min(), values.max()
    above = values[values > low]
    most = np.quantile(above, share, method="higher") if above.size else high
    return np.array([low, most if high - low > much * (most - low) else high, high])


def draw_profile(
    path: str | os.PathLike[str],
    curves: Mapping[str, Sequence[Any]],
    xlabel: str,
    ylabel: str,
    title: str = "",
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> None:
    """Draw curves, such as the contact pressure along a line. Collective.

    Parameters
    ----------
    path : path-like
        The .png file. Its folder is created if it does not exist.
    curves : dict of str to (x, y) or (x, y, style)
        Name of each curve, and its points, two arrays (n,). The style is Matplotlib's: "-" for a
        line, "o" for points, "--", ... Under MPI, the curves of rank 0 are drawn.
    xlabel, ylabel : str
        Labels of the axes, with units.
    title : str
        Title of the picture.
    comm : MPI.Comm
        The ranks that call; MPI.COMM_SELF if only one does.

    Raises
    ------
    InputError
        If an argument is wrong.
    ImportError
        If Matplotlib is missing. All errors are raised on all ranks.

    Examples
    --------
    >>> curves = {"joint": (x, pressure, "o"), "Hertz": (x, exact, "-")}  # doctest: +SKIP
    >>> draw_profile("pressure.png", curves, "x [m]", "pressure [Pa]")  # doctest: +SKIP
    """
    path = Path(path)
    meet(comm, "draw_profile()")
    with raise_collectively(comm):
        _check_path(path)
        if comm.rank == 0:
            _require("matplotlib")
            if not curves:
                raise InputError("there are no curves to draw: pass at least one")
            points = {name: _points(name, curve) for name, curve in curves.items()}
            picture = _plot(points, xlabel, ylabel, title)
            _write(path, picture)


def write_gif(
    path: str | os.PathLike[str],
    pictures: Sequence[str | os.PathLike[str]],
    *,
    seconds: float = 0.25,
    width: int = 720,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
) -> None:
    """Join pictures, such as those of load steps, to an animation. Collective.

    The last picture stays six times as long as the others, and the animation begins again.

    Parameters
    ----------
    path : path-like
        The .gif file. Its folder is created if it does not exist.
    pictures : sequence of path-like
        PNG files of the same size, as `draw_deformed` writes them, in their order.
    seconds : float
        How long each picture is shown [s].
    width : int
        Width of the animation [pixels].
    comm : MPI.Comm
        The ranks that call; rank 0 reads and writes.

    Raises
    ------
    InputError
        If there are no pictures, or an argument is wrong.
    OSError
        If a picture cannot be read, or the file cannot be written.
    ImportError
        If Pillow is missing. All errors are raised on all ranks.

    Examples
    --------
    >>> for step, load.value in enumerate(loads):  # doctest: +SKIP
    ...     problem.solve()
    ...     problem.draw(f"step_{step:03}.png", limits=(0, 5))
    >>> write_gif("steps.gif", sorted(Path().glob("step_*.png")))  # doctest: +SKIP
    """
    path = Path(path)
    meet(comm, "write_gif()")
    with raise_collectively(comm):
        if path.suffix != ".gif":
            raise InputError(f"'{path}' does not end in .gif, the only supported format")
        check_value(is_number(seconds) and seconds > 0, "write_gif: seconds", seconds, "seconds")
        if comm.rank == 0:
            _require("PIL", "pillow")
            if not len(pictures):
                raise InputError("there are no pictures to join: pass at least one")
            _write(path, _joined([Path(picture) for picture in pictures], seconds, width))


def _joined(pictures: Sequence[Path], seconds: float, width: int) -> bytes:
    """Return an animation with few colours as a GIF file."""
    from PIL import Image

    colours, milliseconds = 64, round(1000 * seconds)
    frames = []
    for picture in pictures:
        with Image.open(picture) as image:
            height = round(image.height * width / image.width)
            frame = image.convert("RGB").resize((width, height))
            frames.append(frame.quantize(colours, Image.Quantize.FASTOCTREE))
    times = [milliseconds] * (len(frames) - 1) + [6 * milliseconds]
    animation, (first, *others) = BytesIO(), frames
    first.save(animation, format="GIF", save_all=True, append_images=others, duration=times, loop=0)
    return animation.getvalue()


def _render(path: Path, data: dict[str, Any]) -> None:
    """Draw in another process, and move the picture to its path only on success."""
    seconds = 600  # drawing takes a few seconds, without a graphics card
    # without MPI's variables, by which the process would take itself for a rank of this run
    prefixes = ("OMPI_", "PMI_", "PMIX_", "PRTE_", "MPI_", "MPIR_", "HYDRA_", "HYDI_", "SLURM_")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(prefixes)}
    environment["PYVISTA_OFF_SCREEN"] = "true"
    with tempfile.TemporaryDirectory() as folder:
        data_path, picture_path = Path(folder, "data.npz"), Path(folder, "picture.png")
        write_arrays(data_path, "the data of a picture", "fenics_tfeti picture 1", data)
        # -P keeps the folder of the script off the search path: gmsh.py would hide the package
        command = [sys.executable, "-P", str(_RENDER), str(data_path), str(picture_path)]
        try:
            child = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=seconds
            )
        except subprocess.TimeoutExpired as error:
            raise RuntimeError(
                f"drawing {path} took more than {seconds} s and was stopped; write the fields by "
                "write_fields and draw them in ParaView"
            ) from error
        _log.debug("drawing %s: %s", path, child.stderr)
        if child.returncode != 0 or not picture_path.is_file():
            raise RuntimeError(
                f"drawing {path} failed (exit code {child.returncode}); VTK needs off-screen "
                f"rendering, by OSMesa or EGL for example. It printed:\n{child.stderr[-2000:]}"
            )
        _write(path, picture_path.read_bytes())


def _write(path: Path, picture: bytes) -> None:
    """Write a picture whole or not at all."""
    with folder_of(path):
        write_whole(path, "the picture", lambda file: file.write(picture))


def _plot(
    curves: dict[str, tuple[Vector, Vector, str]], xlabel: str, ylabel: str, title: str
) -> bytes:
    """Draw curves on a figure of its own, as a PNG file; pyplot could change the user's figures."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ink, grey = "#22262b", "#d5d8dc"
    figure = Figure(figsize=(8, 4.8), dpi=200, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.15, h_pad=0.12)
    axes = figure.add_subplot()
    for name, (x, y, style) in curves.items():
        axes.plot(x, y, style, label=name, markersize=4.5, linewidth=1.6)
    axes.set_xlabel(xlabel, color=ink)
    axes.set_ylabel(ylabel, color=ink)
    axes.set_title(title, loc="left", color=ink, fontsize=13, pad=12)
    axes.grid(color=grey, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=ink)
    if len(curves) > 1:
        axes.legend(frameon=False, labelcolor=ink)
    picture = BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def _points(name: str, curve: Sequence[Any]) -> tuple[Vector, Vector, str]:
    """Check the points and the style of a curve."""
    if len(curve) not in (2, 3):
        raise InputError(f"the curve '{name}' has {len(curve)} parts; give (x, y) or (x, y, style)")
    x, y = (np.asarray(part, dtype=float) for part in curve[:2])
    if x.ndim != 1 or x.shape != y.shape:
        raise InputError(
            f"the curve '{name}' has x of shape {x.shape} and y of shape {y.shape}; both must "
            "have the same shape (n,)"
        )
    return x, y, str(curve[2]) if len(curve) == 3 else "-"


def _check_limits(limits: Any) -> None:
    if limits is None:
        return
    fits = np.shape(limits) == (2,) and all(map(is_number, limits)) and limits[0] < limits[1]
    check_value(fits, "draw_deformed: limits", limits, "two numbers, the smaller one first")


def _check_section(section: Any, displacement: Function) -> None:
    if section is None:
        return
    if displacement.function_space.mesh.geometry.dim == 2:
        raise InputError("draw_deformed: a section is for bodies in three dimensions")
    plane = np.asarray(section, dtype=float)
    fits = plane.shape == (2, 3) and np.all(np.isfinite(plane)) and plane[1].any()
    expected = "a point and a normal of 3 numbers each"
    check_value(bool(fits), "draw_deformed: section", section, expected)


def _check_path(path: Path) -> None:
    if path.suffix != ".png":
        raise InputError(f"'{path}' does not end in .png, the only supported format")


def _require(module: str, package: str = "") -> None:
    """Check that a module is installed, without importing it."""
    if importlib.util.find_spec(module) is None:
        # without the limit, pip may install a NumPy too new for installed compiled modules
        limit = int(np.__version__.split(".")[0]) + 1
        raise ImportError(
            f"this picture needs the Python module {module}; install it with "
            f"'pip install {package or module} \"numpy<{limit}\"'"
        )
