"""The report of a solve as one HTML page that needs nothing else: text, curves and the bodies."""

from __future__ import annotations

import gzip
import json
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

from fenics_tfeti.errors import first_few, without_places
from fenics_tfeti.fem.io.scene import Scene
from fenics_tfeti.fem.io.units import Units, units_of
from fenics_tfeti.typing import Vector

_STYLE = Path(__file__).with_name("page.css")
_QUANTITIES = {
    "displacement": "length", "contact_pressure": "pressure", "von_mises_stress": "pressure",
}  # fmt: skip
_MARGIN = {"l": 70, "r": 15, "t": 10, "b": 45}
_MAGNIFICATIONS = np.linspace(0.0, 2.0, 5)  # relative to that which makes displacements visible

# of bodies in the plane, and in space, where Plotly would leave small faces without a normal
_EVEN = {"ambient": 1, "diffuse": 0}
_SHADED = {"ambient": 0.8, "diffuse": 0.3, "facenormalsepsilon": 0, "vertexnormalsepsilon": 0}


# Plotly and the figures come compressed, since Plotly alone has 5 MB
_UNPACK = """
const packed = Uint8Array.from(atob(document.getElementById("packed").textContent), (c) => c.charCodeAt(0));
const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
new Response(stream).text().then((code) => {
  const script = document.createElement("script");
  script.textContent = code;
  document.head.append(script);
});
"""  # noqa: E501


# A figure begins with the frames that its layout names, whose arrays the page has once.
_DRAW = """
function draw(name, figure) {
  for (const first of figure.layout.meta || []) {
    // a copy, since Plotly writes the next frame into what is shown
    const frame = figure.frames.find((frame) => frame.name === first);
    Object.assign(figure.data[0], structuredClone(frame.data[0]));
  }
  Plotly.newPlot(name, figure);
}
"""


def report_page(report: Mapping[str, Any], title: str, scene: Scene | None = None) -> str:
    """Return the page for what `ContactReport.to_dict` returns; it contains Plotly's JavaScript.

    What has been computed comes first, then how.
    """
    units = units_of(report["options"]["units"], report["per_length"])
    figures = {} if scene is None else {"bodies": _bodies(scene, units)}
    body = [_verdict(report, title, units)]
    if scene is not None:
        body += ["<h2>Deformed bodies</h2>", _div("bodies")]
    body += _contacts(report, units) + _forces(report, units) + _bolts(report, units)
    body += _rigid_bodies(report, units) + _motions(report) + _solver(report, units)
    figures["convergence"] = _convergence(report, units)
    body += ["<h2>Convergence</h2>", _div("convergence")]
    if report["passes"]:
        figures["passes"] = _passes(report["passes"])
        body += ["<h2>Geometry passes</h2>", _div("passes")]
    figures["phases"] = _phases(report["seconds"])
    body += [*_certificate(report), "<h2>Phases</h2>", _div("phases"), *_details(report)]
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>",
            f"<style>\n{_STYLE.read_text()}</style>\n</head>\n<body>",
            *body,
            f'<script type="text/plain" id="packed">{_packed(figures)}</script>',
            f"<script>{_UNPACK}</script>",
            "</body>\n</html>\n",
        ]
    )


def _div(name: str) -> str:
    """Return the element of a page that a figure is drawn in."""
    return f'<div class="figure {name}"><div id="{name}" class="plotly-graph-div"></div></div>'


def _packed(figures: Mapping[str, go.Figure]) -> str:
    """Return Plotly and the figures as JavaScript, compressed."""
    config = json.dumps({"responsive": True, "displaylogo": False})
    code = [get_plotlyjs(), _DRAW]
    for name, figure in figures.items():
        figure.update_layout(template="plotly_white", font={"family": "system-ui, sans-serif"})
        code.append(f'draw("{name}", {{...{figure.to_json()}, config: {config}}});')
    return b64encode(gzip.compress("\n".join(code).encode(), mtime=0)).decode()


def _verdict(report: Mapping[str, Any], title: str, units: Units) -> str:
    to_check = [("to check", finding) for finding in report["to_check"]]
    kind = "verdict check" if to_check else "verdict"
    if not report["converged"]:
        kind = "verdict open"
    displacement = f"{_number(report['largest_displacement'])} {units.length}"
    of_mesh = report.get("mesh_error")
    facts = [
        *to_check,
        ("result", report["reason"]),
        ("largest displacement", displacement),
        ("largest strain", _number(report["largest_strain"])),
        *([("error of the mesh", _mesh_error(of_mesh))] if of_mesh else []),
    ]
    return f'<h1>{escape(title)}</h1>\n<div class="{kind} wide">{_table(facts)}</div>'


def _solver(report: Mapping[str, Any], units: Units) -> list[str]:
    unknowns, error = report["unknowns"], _number(report["certificate"]["error"])
    friction = f"{unknowns['sticking']} of {unknowns['friction']} nodes stick"
    facts = [
        ("error of the iterations", f"at most {error} in the energy norm, without the mesh's"),
        ("unknowns", f"{unknowns['primal']} in {report['subdomains']} subdomains"),
        ("contact conditions", f"{unknowns['active']} of {unknowns['inequalities']} active"),
        *([("friction", friction)] if unknowns["friction"] else []),
        ("iterations", f"{report['products']['total']} applications of the dual operator"),
        ("time", f"{report['seconds']['total']:.3g} s, MPI ranks: {report['ranks']}"),
        ("potential energy", f"{_number(report['energy'])} {units.energy}"),
    ]
    return ["<h2>Solver</h2>", f'<div class="wide">{_table(facts)}</div>']


def _motions(report: Mapping[str, Any]) -> list[str]:
    """Return the motions that nothing resists, or tilted normals only."""
    rows: list[Sequence[Any]] = [("motion", "")]
    for kind in ("free", "weak"):
        motions = first_few(report[f"{kind}_motions"], 6, f"{kind} motions")
        rows += [(kind, without_places(motion)) for motion in motions]
    return _section("Motions that are not held", rows)


def _mesh_error(entry: Mapping[str, Any]) -> str:
    bodies = [f"{name} {100 * of['error']:.2g} %" for name, of in entry["bodies"].items()]
    listed = f" ({', '.join(first_few(bodies, 4, 'bodies'))})" if len(bodies) > 1 else ""
    return f"about {100 * entry['error']:.2g} % in the energy norm{listed}"


def _section(title: str, rows: Sequence[Sequence[Any]]) -> list[str]:
    """Return a table with a title, if it has rows below its head."""
    table = f'<div class="wide">{_table(rows, head=True)}</div>'
    return [f"<h2>{title}</h2>", table] if len(rows) > 1 else []


def _contacts(report: Mapping[str, Any], units: Units) -> list[str]:
    columns, force = 6 if report["unknowns"]["friction"] else 5, f"[{units.force}]"
    head = ["contact", f"normal force {force}", f"force on the slave {force}"]
    head += [f"largest pressure [{units.pressure}]", "nodes that press"]
    rows: list[Sequence[Any]] = [[*head, f"work of friction [{units.energy}]"][:columns]]
    for contact in report["contacts"]:
        vector, largest = _vector(contact["force"]), contact["largest_pressure"]
        pressure = "" if largest is None else _number(largest)
        row = [contact["name"], _number(contact["normal_force"]), vector, pressure]
        row += [contact["pressing"], _number(contact["friction_work"])]
        rows.append(row[:columns])
    return _section("Contact", rows)


def _forces(report: Mapping[str, Any], units: Units) -> list[str]:
    """Return the load and what holds it; forces from outside are in balance."""
    rows: list[Sequence[Any]] = [("", f"force [{units.force}]", f"moment [{units.moment}]")]
    for entry in (report["load"], *report["reactions"], report["springs"]):
        if any(entry["force"]) or any(entry["moment"]):
            rows.append((entry["name"], _vector(entry["force"]), _vector(entry["moment"])))
    return _section("Load and supports", rows)


def _bolts(report: Mapping[str, Any], units: Units) -> list[str]:
    bolts = [contact for contact in report["contacts"] if contact["tension"] is not None]
    rows = [("bolt", f"tension [{units.force}]", f"shortening [{units.length}]")]
    rows += [(b["name"], _number(b["tension"]), _number(b["shortening"])) for b in bolts]
    return _section("Bolts", rows)


def _rigid_bodies(report: Mapping[str, Any], units: Units) -> list[str]:
    columns = {"translation": units.length, "rotation": "rad"}
    columns |= {"force": units.force, "moment": units.moment}
    columns |= {"reaction": units.force, "reaction_moment": units.moment}
    head = (f"{name.replace('_', ' ')} [{unit}]" for name, unit in columns.items())
    rows = [("rigid body", *head)]
    for body in report["rigid_bodies"]:
        rows.append((body["name"], *(_vector(body[name]) for name in columns)))
    return _section("Rigid bodies", rows)


def _certificate(report: Mapping[str, Any]) -> list[str]:
    certificate, rtol = report["certificate"], report["options"]["rtol"]
    rows: list[Sequence[Any]] = [("", f"relative; at most rtol = {_number(rtol)}")]
    names = ["error", "equilibrium", "penetration", "smallest_force", "complementarity"]
    if report["unknowns"]["friction"]:
        names += ["friction_excess", "slip_below_bound", "slip_across_force"]
    rows += [(name.replace("_", " "), _number(certificate[name])) for name in names]
    rows += [
        (f"error of {without_places(', '.join(group['bodies']))}", _number(group["error"]))
        for group in certificate["groups"]
    ]
    rows += [
        (f"share of {without_places(body['body'])}", _number(body["error"]))
        for body in certificate["bodies"]
    ]
    return _section("Certificate", rows)


def _details(report: Mapping[str, Any]) -> list[str]:
    return [
        f'<details><summary>{name}</summary><div class="wide">{_table(report[name].items())}</div>'
        "</details>"
        for name in ("options", "versions", "unknowns", "products")
    ]


def _table(rows: Iterable[Sequence[Any]], head: bool = False) -> str:
    lines = []
    for number, row in enumerate(rows):
        first = head and number == 0
        cells = [escape(str(value)) for value in row]
        kinds = ["th" if first or column == 0 else "td" for column in range(len(cells))]
        written = [f"<{kind}>{cell}</{kind}>" for kind, cell in zip(kinds, cells, strict=True)]
        lines.append(f"<tr>{''.join(written)}</tr>")
    return f"<table>{''.join(lines)}</table>"


def _number(value: float | None) -> str:
    # None stands for infinite numbers and NaN
    return "not finite" if value is None else f"{value:.4g}"


def _vector(values: Sequence[float | None]) -> str:
    """Return components, of which those that are rounding beside the largest are zero."""
    finite = [abs(value) for value in values if value is not None]
    least = 1e-9 * max(finite, default=0.0)
    return ", ".join(_number(0.0 if v is not None and abs(v) <= least else v) for v in values)


def _positive(values: Iterable[float | None]) -> list[float | None]:
    """Return numbers for a logarithmic axis, where zeros have no place."""
    return [value if value is not None and value > 0.0 else None for value in values]


def _convergence(report: Mapping[str, Any], units: Units) -> go.Figure:
    """Return the residuals of the last solution by products with F."""
    curves = [
        ("faces", "residual", f"active set: residual [{units.length}]"),
        ("history", "gradient", "SMALBE-M: |g^P| / |b|"),
        ("history", "constraint", "SMALBE-M: |Gx| / |b|"),
    ]
    traces = [
        go.Scatter(
            x=[step["products"] for step in report[steps]],
            y=_positive(step[residual] for step in report[steps]),
            mode="lines+markers",
            name=label,
        )
        for steps, residual, label in curves
        if report[steps]
    ]
    layout = {"showlegend": True, "legend": {"orientation": "h", "y": 1.12}, "margin": _MARGIN}
    layout |= {"xaxis": {"title": "applications of the dual operator", "rangemode": "tozero"}}
    return go.Figure(traces, layout | {"yaxis": {"type": "log", "exponentformat": "power"}})


def _passes(passes: Sequence[Mapping[str, Any]]) -> go.Figure:
    error = _positive(entry["error"] for entry in passes)
    trace = go.Scatter(x=list(range(1, len(passes) + 1)), y=error, mode="lines+markers")
    error_axis = {"type": "log", "title": "relative error", "exponentformat": "power"}
    layout = {"xaxis": {"title": "pass", "dtick": 1}, "yaxis": error_axis, "margin": _MARGIN}
    return go.Figure(trace, layout)


def _phases(seconds: Mapping[str, float]) -> go.Figure:
    phases = {name: time for name, time in reversed(list(seconds.items())) if name != "total"}
    bars = go.Bar(x=list(phases.values()), y=list(phases), orientation="h")
    return go.Figure(bars, {"xaxis": {"title": "seconds"}, "margin": {**_MARGIN, "l": 130}})


def _bodies(scene: Scene, units: Units) -> go.Figure:
    """Return the deformed bodies, with a menu of fields and a slider of the magnification."""
    scene = scene.triangulated()
    corners = scene.faces.astype(np.uint16 if len(scene.points) < 2**16 else np.int32)
    # no finer than a pixel of a large screen: zeros at the end of numbers are compressed
    step = 2.0 ** np.floor(np.log2(max(np.ptp(scene.points, axis=0).max(), 1e-300) / 2**13))

    def places(scale: float) -> dict[str, Any]:
        rounded = step * np.rint((scene.points + scale * scene.displacement) / step)
        return dict(zip("xyz", rounded.T.astype(np.float32), strict=True))

    colours = {name.replace("_", " "): _colours(scene, name, units) for name in scene.fields}
    # what the user has chosen to see is seen first, the size of the displacement else
    first = list(colours)[min(1, len(colours) - 1)]
    scales = {f"{scale:.3g}": places(scale) for scale in scene.scale * _MAGNIFICATIONS}
    middle = len(scales) // 2
    mesh = go.Mesh3d(
        **dict(zip("ijk", corners.T, strict=True)),
        colorscale="YlOrRd",
        flatshading=True,
        lighting=_EVEN if scene.flat else _SHADED,
        hovertemplate="%{intensity:.4g}<extra></extra>",
    )
    # frames, since Plotly writes their arrays as bytes
    frames = [
        go.Frame(name=name, data=go.Mesh3d(data)) for name, data in (colours | scales).items()
    ]
    eye = {"x": 0, "y": 0, "z": 2} if scene.flat else {"x": -1.0, "y": -1.5, "z": 0.9}
    layout = {
        "meta": [first, list(scales)[middle]],
        "margin": {"l": 0, "r": 12, "t": 40, "b": 105},
        "scene": {
            "domain": {"y": [0.2, 1]},
            "aspectmode": "data",
            **{f"{axis}axis": {"visible": False} for axis in "xyz"},
            "camera": {"eye": eye, "up": {"y": 1} if scene.flat else {"z": 1}},
            "dragmode": "orbit",
            "uirevision": "kept",  # what the user has turned stays
        },
        "updatemenus": [
            {
                "buttons": _steps(colours),
                "active": list(colours).index(first),
                "x": 0,
                "xanchor": "left",
                "y": 1,
                "yanchor": "bottom",
            }
        ],
        "sliders": [
            {
                "steps": _steps(scales),
                "active": middle,
                "currentvalue": {"prefix": "displacements × "},
            }
        ],
    }
    return go.Figure(mesh, layout, frames)


def _colours(scene: Scene, name: str, units: Units) -> dict[str, Any]:
    values = scene.fields[name]
    label = name.replace("_", " ")
    if name in _QUANTITIES:
        label += f" [{getattr(units, _QUANTITIES[name])}]"
    bar = {"title": {"text": label, "side": "top"}, "orientation": "h", "y": 0, "len": 0.9}
    return {
        "intensity": _to_four_digits(values.ravel()),
        "intensitymode": "vertex" if values.ndim == 1 else "cell",
        "colorbar": {**bar, "yanchor": "bottom", "thickness": 14},
    }


def _to_four_digits(values: Vector) -> NDArray[np.float32]:
    """Round numbers to a few binary digits, more than those that are shown."""
    mantissa, exponent = np.frexp(values)
    return np.ldexp(np.rint(mantissa * 2**14) / 2**14, exponent).astype(np.float32)


def _steps(frames: Iterable[str]) -> list[dict[str, Any]]:
    """Return the entries of a menu or slider that show frames, at once."""
    how = {"mode": "immediate", "frame": {"duration": 0}, "transition": {"duration": 0}}
    return [{"label": name, "method": "animate", "args": [[name], how]} for name in frames]
