"""The report of a solve as one HTML page that needs nothing else: text, curves and the bodies."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.fem.io.scene import Scene

_FOLDER = Path(__file__).parent

_UNITS = {"displacement": "m", "contact_pressure": "Pa", "von_mises_stress": "Pa"}


def report_page(report: Mapping[str, Any], title: str, scene: Scene | None = None) -> str:
    """Return the page for what `ContactReport.to_dict` returns; it contains Plotly's JavaScript."""
    library = _plotly()
    figures = {"convergence": _convergence(report), "phases": _phases(report["seconds"])}
    if report["passes"]:
        figures["passes"] = _passes(report["passes"])
    data = {"figures": figures, "scene": None if scene is None else _scene(scene)}
    body = [_verdict(report, title), *_bodies(scene), *_contacts(report), *_iterations(report)]
    phases = ["<h2>Phases</h2>", '<div class="figure" id="phases"></div>']
    body += [*_certificate(report), *phases, *_details(report)]
    # in an element of its own, whose end must not be in the data
    text = json.dumps(data, allow_nan=False).replace("</", "<\\/")
    script = (_FOLDER / "page.js").read_text()
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>",
            f"<style>\n{(_FOLDER / 'page.css').read_text()}</style>",
            f"<script>{library}</script>\n</head>\n<body>",
            *body,
            f'<script type="application/json" id="data">{text}</script>',
            f"<script>\n{script}</script>\n</body>\n</html>\n",
        ]
    )


def _plotly() -> str:
    if find_spec("plotly") is None:
        raise ImportError("the page needs the Python module plotly: pip install plotly")
    from plotly.offline import get_plotlyjs

    library: str = get_plotlyjs()
    return library


def _verdict(report: Mapping[str, Any], title: str) -> str:
    kind = "verdict" if report["converged"] else "verdict open"
    error = _number(report["certificate"]["error"])
    unknowns, products = report["unknowns"], report["products"]
    friction = f"{unknowns['sticking']} of {unknowns['friction']} nodes stick"
    facts = [
        ("result", report["reason"]),
        ("error of the displacement", f"at most {error}, relative, in the energy norm"),
        ("unknowns", f"{unknowns['primal']} in {report['subdomains']} subdomains"),
        ("contact", f"{unknowns['active']} of {unknowns['inequalities']} conditions active"),
        *([("friction", friction)] if unknowns["friction"] else []),
        ("products with F", products["total"]),
        ("time", f"{report['seconds']['total']:.3g} s, MPI ranks: {report['ranks']}"),
        ("potential energy", f"{_number(report['energy'])} J"),
        *(("free motion", motion) for motion in report["free_motions"]),
        *(("weak motion", motion) for motion in report["weak_motions"]),
    ]
    return f'<h1>{escape(title)}</h1>\n<div class="{kind} wide">{_table(facts)}</div>'


def _bodies(scene: Scene | None) -> list[str]:
    if scene is None:
        return []
    options = "".join(f"<option>{escape(name.replace('_', ' '))}</option>" for name in scene.fields)
    return [
        "<h2>Deformed bodies</h2>",
        f'<div class="controls"><label>colour <select id="field">{options}</select></label>',
        '<label>displacements <input type="range" id="scale" min="0" max="2" step="0.05" value="1">'
        '</label><span id="factor"></span></div>',
        '<div class="figure" id="bodies"></div>',
    ]


def _contacts(report: Mapping[str, Any]) -> list[str]:
    contacts, has_friction = report["contacts"], bool(report["unknowns"]["friction"])
    if not contacts:
        return []
    rows: list[Sequence[Any]] = [("contact", "normal force [N]", "force on the slave [N]", "pairs")]
    if has_friction:
        rows = [(*rows[0], "work of friction [J]")]
    for contact in contacts:
        force, vector = contact["normal_force"], ", ".join(map(_number, contact["force"]))
        row = (contact["name"], _number(force), vector, contact["pairing"]["pairs"])
        rows.append((*row, _number(contact["friction_work"])) if has_friction else row)
    return ["<h2>Contact</h2>", f'<div class="wide">{_table(rows, head=True)}</div>']


def _iterations(report: Mapping[str, Any]) -> list[str]:
    sections = ["<h2>Convergence</h2>", '<div class="figure" id="convergence"></div>']
    if report["passes"]:
        sections += ["<h2>Geometry passes</h2>", '<div class="figure" id="passes"></div>']
    return sections


def _certificate(report: Mapping[str, Any]) -> list[str]:
    certificate, rtol = report["certificate"], report["options"]["rtol"]
    rows: list[Sequence[Any]] = [("", f"relative; at most rtol = {_number(rtol)}")]
    names = ["error", "equilibrium", "penetration", "smallest_force", "complementarity"]
    if report["unknowns"]["friction"]:
        names += ["friction_excess", "slip_below_bound", "slip_across_force"]
    rows += [(name.replace("_", " "), _number(certificate[name])) for name in names]
    rows += [
        (f"error of {', '.join(group['bodies'])}", _number(group["error"]))
        for group in certificate["groups"]
    ]
    rows += [(f"share of {body['body']}", _number(body["error"])) for body in certificate["bodies"]]
    return ["<h2>Certificate</h2>", f'<div class="wide">{_table(rows, head=True)}</div>']


def _details(report: Mapping[str, Any]) -> list[str]:
    sections = []
    for name in ("options", "versions", "unknowns", "products"):
        table = _table(list(report[name].items()))
        sections.append(
            f'<details><summary>{name}</summary><div class="wide">{table}</div></details>'
        )
    return sections


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


def _positive(values: Iterable[float | None]) -> list[float | None]:
    """Return numbers for a logarithmic axis, where zeros have no place."""
    return [value if value is not None and value > 0.0 else None for value in values]


def _convergence(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the residuals of the last solution by products with F."""
    faces, outer = report["faces"], report["history"]
    traces = []
    if faces:
        traces.append(_curve(faces, "residual", "active set: residual [m]"))
    if outer:
        traces.append(_curve(outer, "gradient", "SMALBE-M: |g^P| / |b|"))
        traces.append(_curve(outer, "constraint", "SMALBE-M: |Gx| / |b|"))
    layout = {
        "xaxis": {"title": {"text": "products with F"}, "rangemode": "tozero"},
        "yaxis": {"type": "log", "exponentformat": "power"},
        "showlegend": True,
        "legend": {"orientation": "h", "y": 1.12},
    }
    return {"traces": traces, "layout": layout}


def _curve(steps: Sequence[Mapping[str, Any]], name: str, label: str) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "x": [step["products"] for step in steps],
        "y": _positive(step[name] for step in steps),
        "name": label,
    }


def _passes(passes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    numbers = list(range(1, len(passes) + 1))
    error = _positive(entry["error"] for entry in passes)
    trace = {"type": "scatter", "mode": "lines+markers", "x": numbers, "y": error}
    layout = {
        "xaxis": {"title": {"text": "pass"}, "dtick": 1},
        "yaxis": {"type": "log", "title": {"text": "relative error"}, "exponentformat": "power"},
    }
    return {"traces": [trace], "layout": layout}


def _phases(seconds: Mapping[str, float]) -> dict[str, Any]:
    phases = {name: time for name, time in reversed(list(seconds.items())) if name != "total"}
    bar = {"type": "bar", "orientation": "h", "x": list(phases.values()), "y": list(phases)}
    layout = {"margin": {"l": 130, "r": 15, "t": 10, "b": 45}}
    return {"traces": [bar], "layout": {**layout, "xaxis": {"title": {"text": "seconds"}}}}


def _scene(scene: Scene) -> dict[str, Any]:
    """Return the bodies with arrays as text; JSON numbers would take thrice the space."""
    fields = [
        {
            "label": f"{name.replace('_', ' ')} [{_UNITS[name]}]" if name in _UNITS else name,
            "mode": "vertex" if len(values) == len(scene.points) else "cell",
            "values": _text(values),
        }
        for name, values in scene.fields.items()
    ]
    return {
        "points": [_text(x) for x in scene.points.T],
        "displacement": [_text(x) for x in scene.displacement.T],
        "triangles": [_text(x, np.int32) for x in scene.triangles.T],
        "fields": fields,
        "scale": scene.scale,
        "flat": scene.flat,
    }


def _text(values: NDArray[Any], kind: type[np.generic] = np.float32) -> str:
    array = np.ascontiguousarray(values).astype(np.dtype(kind).newbyteorder("<"))
    return base64.b64encode(array.tobytes()).decode()
