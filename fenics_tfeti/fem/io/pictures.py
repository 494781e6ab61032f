"""Pictures of solutions in PNG files, made without a display."""

from __future__ import annotations

import importlib.util
import logging
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.io.fields import field_degree
from fenics_tfeti.parallel import raise_collectively

__all__ = ["draw_deformed", "draw_profile"]

_log = logging.getLogger(__name__)

_RENDER = Path(__file__).with_name("_render.py")
_PATIENCE = 600  # seconds; drawing takes a few, without a graphics card

_IN_SI = {
    "": 1.0, "m": 1.0, "mm": 1e-3, "µm": 1e-6, "Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9,
    "N": 1.0, "kN": 1e3, "MN": 1e6,
}  # fmt: skip

# Vertices in the order of VTK, numbered as dolfinx does
_TO_VTK = {
    "triangle": [0, 1, 2],
    "quadrilateral": [0, 1, 3, 2],
    "tetrahedron": [0, 1, 2, 3],
    "hexahedron": [0, 1, 3, 2, 4, 5, 7, 6],
}


def draw_deformed(
    path: str | os.PathLike[str],
    displacement: Function,
    colour: Function | None = None,
    *,
    label: str | None = None,
    unit: str = "",
    title: str = "",
    scale: float | None = None,
    camera: Sequence[float] = (-0.6, -1.0, 0.55),
    colour_map: str = "YlOrRd",
    size: tuple[int, int] = (1600, 1000),
) -> None:
    """Draw the deformed mesh, coloured by a field, and the outline of the undeformed one.

    Under MPI, rank 0 gathers the whole mesh and draws it. Collective.

    Parameters
    ----------
    path : path-like
        The .png file. Its folder is made if need be.
    displacement : dolfinx.fem.Function
        Continuous, of degree 1, with as many components as the mesh has dimensions [m].
    colour : dolfinx.fem.Function, optional
        A scalar, continuous of degree 1 or constant on each cell, in SI units. By default the
        magnitude of the displacement.
    label : str, optional
        What the colours mean; by default the name of `colour`.
    unit : str
        Unit beside the colour bar: the numbers are converted from SI. One of m, mm, µm, Pa, kPa,
        MPa, GPa, N, kN, MN; empty for numbers as they are.
    title : str
        Headline.
    scale : float, optional
        Factor by which displacements are magnified. By default the roundest one that makes the
        largest displacement about a tenth of the size of the mesh. It is told in the picture.
    camera : sequence of 3 floats
        Direction from the mesh to the viewer; the z axis points up. In two dimensions the view
        is along the z axis.
    colour_map : str
        A colour map of Matplotlib.
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
    The picture is drawn by another Python process, since libraries for graphics and dolfinx do
    not always get along in one.
    """
    path = Path(path)
    comm = displacement.function_space.mesh.comm
    with raise_collectively(comm):
        _check_path(path)
        _check_displacement(displacement)
        _check_colour(displacement, colour)
        if unit not in _IN_SI:
            raise InputError(f"unknown unit '{unit}'; choose one of {', '.join(_IN_SI)[2:]}")
        if comm.rank == 0:
            _need("pyvista")
    view = _gather(displacement, colour)
    with raise_collectively(comm):
        if view is not None:
            if scale is None:
                scale = _round_scale(view)
            name = label or (colour.name if colour is not None else "displacement")
            data = {
                **vars(view),
                "colours": view.colours / _IN_SI[unit],
                "scale": scale,
                "title": title,
                "label": f"{name} [{unit}]" if unit else name,
                "note": f"displacements × {scale:g}; grey lines: undeformed",
                "camera": np.asarray(camera, dtype=float),
                "colour_map": colour_map,
                "size": np.asarray(size),
            }
            _render(path, data)


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
        The .png file. Its folder is made if need be.
    curves : dict of str to (x, y) or (x, y, style)
        What each curve is called, and its points, two arrays (n,). The style is Matplotlib's:
        "-" for a line, "o" for points, "--", ... Under MPI, the curves of rank 0 are drawn.
    xlabel, ylabel : str
        What the axes mean, with units.
    title : str
        Headline.
    comm : MPI.Comm
        Ranks that take part; MPI.COMM_SELF where only one rank calls.

    Raises
    ------
    InputError
        If an argument is wrong.
    ImportError
        If Matplotlib is missing. All errors are raised on all ranks.
    """
    path = Path(path)
    with raise_collectively(comm):
        _check_path(path)
        if comm.rank == 0:
            _need("matplotlib")
            if not curves:
                raise InputError("there are no curves to draw; pass at least one")
            points = {name: _points(name, curve) for name, curve in curves.items()}
            path.parent.mkdir(parents=True, exist_ok=True)
            _plot(path, points, xlabel, ylabel, title)


@dataclass(frozen=True)
class _View:
    """The whole mesh and its fields.

    Attributes
    ----------
    points, displacement : (n, 3) array
        Nodes and their displacements [m].
    cells : (m, v) array of int
        Their vertices, in the order of VTK.
    colours : (n,) or (m,) array
        A number for each node or cell.
    shape : str
        Shape of the cells.
    """

    points: NDArray[np.float64]
    displacement: NDArray[np.float64]
    cells: NDArray[np.int64]
    colours: NDArray[np.float64]
    shape: str


def _gather(displacement: Function, colour: Function | None) -> _View | None:
    """Gather the mesh and the fields on rank 0; the other ranks get None. Collective."""
    mesh = displacement.function_space.mesh
    shape = _compat.cell_name(mesh)
    order = _TO_VTK[shape]
    owned = mesh.topology.index_map(mesh.topology.dim).size_local
    nodes = _compat.geometry_cells(mesh)[:owned, : len(order)]
    number = mesh.geometry.index_map().local_to_global(np.unique(nodes).astype(np.int32))
    cells = number[np.searchsorted(np.unique(nodes), nodes)]

    # Values cell by cell: the vertices of a cell have one order in all spaces of degree 1.
    gdim = mesh.geometry.dim
    moves = displacement.x.array.reshape(-1, gdim)
    moves = moves[_compat.cell_dofs(displacement.function_space)[:owned]]
    if colour is None:
        colours = np.linalg.norm(moves, axis=2)
    else:
        colours = colour.x.array[_compat.cell_dofs(colour.function_space)[:owned]]
    local = (mesh.geometry.x[nodes], moves, cells, colours)
    ranks = mesh.comm.gather(local)
    if ranks is None:
        return None
    points, moves, cells, colours = (np.concatenate(parts) for parts in zip(*ranks, strict=True))

    _, first, place = np.unique(cells, return_index=True, return_inverse=True)
    by_cell = colours.shape[1] == 1
    return _View(
        points=points.reshape(-1, 3)[first],
        displacement=np.pad(moves.reshape(-1, gdim)[first], ((0, 0), (0, 3 - gdim))),
        cells=place.reshape(cells.shape)[:, order],
        colours=colours[:, 0] if by_cell else colours.ravel()[first],
        shape=shape,
    )


def _round_scale(view: _View) -> float:
    """Return 1, 2 or 5 times a power of ten: the displacements then are a tenth of the size."""
    largest = float(np.linalg.norm(view.displacement, axis=1).max())
    size = float(np.ptp(view.points, axis=0).max())
    if largest == 0.0:
        return 1.0
    wanted = 0.1 * size / largest
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(k for k in (1, 2, 5) if k * power <= wanted * (1 + 1e-9)))


def _render(path: Path, data: dict[str, Any]) -> None:
    """Draw in another process, and put the picture in its place only if that succeeded."""
    # The child must not think that it is a rank of this run.
    prefixes = ("OMPI_", "PMI_", "PMIX_", "PRTE_", "MPI_", "MPIR_", "HYDRA_", "HYDI_", "SLURM_")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(prefixes)}
    environment["PYVISTA_OFF_SCREEN"] = "true"
    with tempfile.TemporaryDirectory() as folder:
        data_path, picture_path = Path(folder, "data.npz"), Path(folder, "picture.png")
        np.savez(data_path, **data)
        # -P keeps the folder of the script, whose modules import dolfinx, off the search path.
        command = [sys.executable, "-P", str(_RENDER), str(data_path), str(picture_path)]
        try:
            child = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=_PATIENCE
            )
        except subprocess.TimeoutExpired as error:
            raise RuntimeError(
                f"drawing {path} took more than {_PATIENCE} s and was stopped; write the fields "
                "by write_fields and draw them in ParaView"
            ) from error
        _log.debug("drawing %s: %s", path, child.stderr)
        if child.returncode != 0 or not picture_path.is_file():
            raise RuntimeError(
                f"drawing {path} failed (exit code {child.returncode}); VTK needs off-screen "
                f"rendering, by OSMesa or EGL for example. Its last words:\n{child.stderr[-2000:]}"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(picture_path, path)


def _plot(
    path: Path,
    curves: dict[str, tuple[NDArray[np.float64], NDArray[np.float64], str]],
    xlabel: str,
    ylabel: str,
    title: str,
) -> None:
    """Draw curves by Matplotlib's objects, which leave the user's own figures alone."""
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
    figure.savefig(path)


def _points(name: str, curve: Sequence[Any]) -> tuple[NDArray[Any], NDArray[Any], str]:
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


def _check_path(path: Path) -> None:
    """Check the name of a picture."""
    if path.suffix != ".png":
        raise InputError(f"'{path}' does not end in .png, and other pictures cannot be made")


def _check_displacement(displacement: Function) -> None:
    """Check that a function is a displacement."""
    mesh = displacement.function_space.mesh
    _, _, shape = _compat.element_facts(displacement.function_space)
    if field_degree(displacement) != 1 or shape != (mesh.geometry.dim,):
        raise InputError(
            f"'{displacement.name}' is no displacement: it must be continuous, of degree 1, and "
            f"have {mesh.geometry.dim} components"
        )
    if not np.all(np.isfinite(displacement.x.array)):
        raise InputError(f"'{displacement.name}' has values that are infinite or no numbers")


def _check_colour(displacement: Function, colour: Function | None) -> None:
    """Check that colours can be made of a function."""
    if colour is None:
        return
    _, _, shape = _compat.element_facts(colour.function_space)
    field_degree(colour)
    if shape != ():
        raise InputError(f"'{colour.name}' of shape {shape} gives no colours; pass a scalar")
    if colour.function_space.mesh is not displacement.function_space.mesh:
        raise InputError(f"'{colour.name}' is on another mesh than '{displacement.name}'")
    if not np.all(np.isfinite(colour.x.array)):
        raise InputError(f"'{colour.name}' has values that are infinite or no numbers")


def _need(module: str) -> None:
    """Check that a module is installed, without importing it."""
    if importlib.util.find_spec(module) is None:
        # Bare, pip might bring a NumPy too new for the compiled modules that are there.
        limit = int(np.__version__.split(".")[0]) + 1
        raise ImportError(
            f"this picture needs the Python module {module}; install it with "
            f"'pip install {module} \"numpy<{limit}\"'"
        )
