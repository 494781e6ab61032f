"""The plan of a solve on many ranks beside runs that were made."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path

import pytest
from new_process import run_python

from fenics_tfeti import InputError, plan
from fenics_tfeti.plan import MESHES, Model, Plan, main, plans

# docs/performance.rst, one machine: subdomains a metre, processor seconds, MB of one rank
LADDERS = [(3, 0.8, 239), (5, 3.3, 543), (7, 9.5, 1245), (9, 23.2, 2737), (18, 279, 22_589)]
BEAMS = [(5, 8.6, 866), (7, 18.8, 2129), (14, 232, 17_711)]
# unknowns, ranks, processor seconds, MB of all ranks
GENERAL = [
    (96_504, 1, 2.07, 487),
    (413_229, 1, 9.4, 1646),
    (966_003, 1, 24.4, 3704),
    (96_504, 2, None, 670),
    (413_229, 2, None, 1821),
    (966_003, 2, None, 3900),
]
FACTOR = 1.5
BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


def of_size(mesh: str, size: int) -> plan.Rates:
    """Return the rates of an option."""
    return next(rates for rates in MESHES[mesh].rates if rates.subdomain_size == size)


def is_near(planned: float, run: float) -> bool:
    return run / FACTOR <= planned <= FACTOR * run


@pytest.mark.parametrize(("m", "seconds", "megabytes"), LADDERS)
def test_ladders(m, seconds, megabytes):
    """431,244 to 93 million torn unknowns."""
    blocks = MESHES["blocks"]
    model = Model(4.0 * m**3, 1, of_size("blocks", 3000), blocks.products, blocks.faces)
    assert is_near(sum(model.seconds.values()), seconds)
    assert is_near(sum(model.bytes.values()), 1e6 * megabytes)


@pytest.mark.parametrize(("m", "seconds", "megabytes"), BEAMS)
def test_beams_from_the_mesh_on(m, seconds, megabytes):
    rates = of_size("blocks", 3000)
    planned = Plan.of(4.0 * m**3 * rates.unknowns, 1, MESHES["blocks"], rates)
    assert is_near(sum(planned.seconds().values()), seconds)
    assert is_near(sum(planned.bytes.values()), 1e6 * megabytes)


@pytest.mark.parametrize(("unknowns", "ranks", "seconds", "megabytes"), GENERAL)
def test_general_meshes(unknowns, ranks, seconds, megabytes):
    planned = Plan.of(unknowns, ranks, MESHES["general"], of_size("general", 3000))
    if seconds is not None:
        assert is_near(sum(planned.seconds().values()), seconds)
    assert is_near(sum(planned.bytes.values()), 1e6 * megabytes / ranks)


RUN = """
import json, sys
sys.path[:0] = sys.argv[1:]
import ladder
from billion import OPTIONS
from peaks import peak_since_last
from fenics_tfeti.feti import TornSolver
report = TornSolver(ladder.two_beams(3, 10, softer=False), OPTIONS).solve().report
# the report's is that of the process that has started this one, if that is larger
print(json.dumps([report.products["total"], peak_since_last()]))
"""


@pytest.mark.once
def test_a_run_here():
    """Products and memory, which do not depend on the machine's speed."""
    folders = BENCHMARKS, BENCHMARKS.parent / "tests" / "support", BENCHMARKS.parent / "meshes"
    products, peak = json.loads(run_python(RUN, *map(str, folders)))
    blocks = MESHES["blocks"]
    model = Model(108.0, 1, of_size("blocks", 3000), blocks.products, blocks.faces)
    assert is_near(model.products, products)
    assert is_near(sum(model.bytes.values()), peak)


def test_more_ranks_have_less_each():
    few, many = (plans(1e8, ranks)[0] for ranks in (64, 512))
    assert sum(many.seconds().values()) < sum(few.seconds().values())
    assert sum(many.bytes.values()) < sum(few.bytes.values())
    assert many.model.solver == "distributed"


def test_spread_of_the_terms(capsys):
    main(["--unknowns", "1e8", "--ranks", "512", "--mesh", "blocks"])
    text = capsys.readouterr().out
    assert "100,000,000 unknowns, blocks mesh, 512 ranks" in text
    low, middle, high = (
        sum(plans(1e8, 512)[0].seconds(machine).values())
        for machine in (plan.FAST, None, plan.SLOW)
    )
    assert low < middle < high
    assert f"{middle:.3g} s ({low:.3g} to {high:.3g})" in text


def test_page_about_the_plan(capsys):
    main(["--unknowns", "1e8", "--ranks", "512"])
    page = (BENCHMARKS.parent / "docs" / "billion.rst").read_text()
    assert textwrap.indent(capsys.readouterr().out.strip(), "    ") in page


def test_the_fastest_is_the_first():
    times = [sum(one.seconds().values()) for one in plans(1e7, 16, "general")]
    assert times == sorted(times)


@pytest.mark.parametrize(("data", "message"), [
    ((1e4, 512), "10000 unknowns on 512 ranks: a rank has one subdomain at least"),
    ((1e6, 0), "on 0 ranks"),
    ((1e6, 1, "hexagons"), "there is no mesh 'hexagons'; there are blocks, general"),
])  # fmt: skip
def test_wrong_plans(data, message):
    with pytest.raises(InputError, match=message):
        plans(*data)


def test_wrong_plan_of_the_command(capsys):
    with pytest.raises(SystemExit):
        main(["--unknowns", "1e4", "--ranks", "512"])
    assert "Take fewer ranks" in capsys.readouterr().err
