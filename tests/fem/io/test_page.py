"""Pages of reports, in a real browser where the system has one."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import sys
from functools import lru_cache

from mpi4py import MPI

import numpy as np
import pytest
import scenes

from fenics_tfeti import InputError
from fenics_tfeti.fem.io.page import report_page
from fenics_tfeti.feti.report.report import without_nan
from fenics_tfeti.io import contact_fields, von_mises

pytestmark = pytest.mark.once

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
with_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium in the path: apt-get install chromium"
)
PHONE, DESKTOP = (390, 844), (1280, 900)


@lru_cache
def solved(cell: str):
    """Return a solved problem, its displacement and two fields."""
    scene = scenes.two_beams(MPI.COMM_SELF, cell, 2)
    problem = scene.problem(options={"non_penetration": "exact"})
    uh = problem.solve()
    stress = von_mises(scene.mesh, scenes.stress(uh, scenes.YOUNG), scenes.POISSON)
    return problem, uh, [contact_fields(scene.V, problem.results)[0], stress]


@pytest.fixture(scope="module")
def written(request, tmp_path_factory):
    """Return the path of a page."""
    problem, uh, fields = solved(request.param)
    path = tmp_path_factory.mktemp("pages") / "page.html"
    problem.report.to_html(path, uh, fields, title="Beams <1 & 2>")
    return path


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        launched = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        yield launched
        launched.close()


def opened(browser, path, size=DESKTOP):
    """Open a page; return it with the errors and requests that it has made."""
    width, height = size
    tab = browser.new_page(viewport={"width": width, "height": height})
    errors, requests = [], []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
    tab.on("request", lambda request: requests.append(request.url))
    tab.goto(path.as_uri())
    tab.wait_for_selector("body[data-drawn=true]", timeout=60_000)
    return tab, errors, requests


@with_browser
@pytest.mark.parametrize(
    ("written", "size"), [("hexahedron", DESKTOP), ("triangle", PHONE)], indirect=["written"]
)
def test_page_draws_without_errors_and_without_the_network(browser, written, size):
    tab, errors, requests = opened(browser, written, size)
    assert errors == [] and requests == [written.as_uri()]
    assert tab.title() == tab.text_content("h1") == "Beams <1 & 2>"
    headings = tab.locator("h2").all_text_contents()
    wanted = ["Deformed bodies", "Contact", "Convergence", "Geometry passes", "Certificate"]
    assert headings == [*wanted, "Phases"]
    assert "converged" in tab.text_content(".verdict")
    # no wider than the screen
    assert tab.evaluate("document.documentElement.scrollWidth") <= size[0]
    for name in ("convergence", "passes", "phases"):
        assert tab.locator(f"#{name} .main-svg").count() > 0
    tab.close()


@with_browser
@pytest.mark.parametrize("written", ["hexahedron"], indirect=True)
def test_bodies_can_be_turned_coloured_and_magnified(browser, written):
    tab, errors, _ = opened(browser, written)
    figure = "document.getElementById('bodies')"
    camera = f"{figure}._fullLayout.scene._scene.getCamera().eye"
    before, picture = tab.evaluate(camera), tab.locator("#bodies canvas").first.screenshot()
    box = tab.locator("#bodies").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.mouse.move(*middle)
    tab.mouse.down()
    tab.mouse.move(middle[0] + 120, middle[1] + 60, steps=8)
    tab.mouse.up()
    tab.wait_for_timeout(500)
    turned = tab.evaluate(camera)
    assert turned != pytest.approx(before, rel=0.05)
    assert tab.locator("#bodies canvas").first.screenshot() != picture

    def largest():
        return tab.evaluate(f"Math.max(...Array.from({figure}._fullData[0].intensity))")

    sizes = [largest()]
    for name in ("contact pressure", "von mises stress"):
        tab.select_option("#field", name)
        sizes.append(largest())
    assert 0 < sizes[0] < 1 < 1e6 < min(sizes[1:])
    # the load bends the beams downwards, below their undeformed lower face
    lowest = f"Math.min(...Array.from({figure}._fullData[0].z))"
    assert tab.evaluate(lowest) < -0.01
    tab.locator("#scale").fill("0")
    assert abs(tab.evaluate(lowest)) < 1e-6
    assert tab.text_content("#factor") == "× 0"
    # what was turned stays turned
    assert tab.evaluate(camera) == pytest.approx(turned, rel=1e-9)
    assert errors == []
    tab.close()


def data_of(text):
    """Return the data of the figures of a page."""
    return json.loads(re.search(r'id="data">(.*?)</script>', text).group(1))


@pytest.mark.parametrize("written", ["hexahedron", "triangle"], indirect=True)
def test_page_has_the_figures_of_the_report(written):
    text = written.read_text()
    markup = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"\b(src|href)=", markup)
    assert "Beams &lt;1 &amp; 2&gt;" in markup and "<1 & 2>" not in markup
    data = data_of(text)
    assert len(data["scene"]["fields"]) == 3
    modes = [field["mode"] for field in data["scene"]["fields"]]
    assert modes == ["vertex", "vertex", "cell"]
    assert len(data["figures"]["passes"]["traces"][0]["x"]) > 1


def test_report_that_is_not_converged():
    """Numbers that are not finite have no place in JSON, nor on a logarithmic axis."""
    report = solved("triangle")[0].report
    certificate = dataclasses.replace(report.certificate, error=np.inf)
    faces = [dataclasses.replace(report.faces[0], residual=0.0)]
    wrong = dataclasses.replace(
        report, converged=False, reason="a </script> limit", certificate=certificate, faces=faces
    )
    whole = json.loads(json.dumps(without_nan(wrong.to_dict())))
    text = report_page(whole, "Open")
    assert 'class="verdict open' in text and "at most not finite" in text
    assert "a &lt;/script&gt; limit" in text
    assert data_of(text)["scene"] is None
    assert data_of(text)["figures"]["convergence"]["traces"][0]["y"] == [None]
    assert 'id="bodies"' not in text.split('id="data"')[0]


def test_wrong_arguments(tmp_path, monkeypatch):
    problem, uh, fields = solved("triangle")
    report = problem.report
    with pytest.raises(InputError, match="pass the displacement"):
        report.to_html(tmp_path / "page.html", None, fields)
    with pytest.raises(InputError, match="a scalar is expected"):
        report.to_html(tmp_path / "page.html", uh, [uh])
    with pytest.raises(OSError, match="the page cannot be written"):
        report.to_html(tmp_path / "missing" / "page.html", uh)
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(ImportError, match="pip install plotly"):
        report.to_html(tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []
