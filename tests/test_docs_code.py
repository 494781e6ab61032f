"""The code in the documentation and in the README runs as printed, and prints what is shown.

Pages that continue the tutorial are given its variables: it is run once.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

from mpi4py import MPI

import gmsh
import literate
import numpy as np
import pytest
import scenes
from demo_runner import UNRENDERED
from msh_files import gmsh_model

import ufl
from dolfinx import fem

import fenics_tfeti
import fenics_tfeti.io
from fenics_tfeti import ContactProblem
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")

# Numbers that differ between versions and machines: products, times, and what rounding leaves.
PHASES = re.compile(r"\([a-z ,.0-9]*\), (?=MPI)")
VARYING = ("time", "products", "error")
ROUNDING = 1e-5


def run_blocks(page: str, given: dict[str, object] | None = None) -> dict[str, object]:
    """Run the blocks of a page, with some variables; return those of its Python code.

    In Markdown a block of text after one of Python has to be what that one prints.
    """
    variables: dict[str, object] = dict(given or {})
    cells = literate.page_cells(page)
    assert any(cell.kind != "text" for cell in cells)
    printed = ""
    for cell in cells:
        if cell.kind == "python":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(cell.content, "<docs>", "exec"), variables)
            printed = out.getvalue()
            print(printed)
        elif cell.kind == "text" and not cell.content.startswith(("mpirun", "python")):
            check_output(cell.content, printed)
        elif cell.kind == "console":
            for line in cell.content.splitlines():
                command = line.removeprefix("$ ").split()
                assert line.startswith("$ ") and command[0] == "python"
                subprocess.run([sys.executable, *command[1:]], check=True, timeout=100)
    return variables


def check_output(shown: str, printed: str) -> None:
    """Compare words, and numbers where they do not depend on rounding."""
    shown_lines, printed_lines = shown.splitlines(), printed.rstrip("\n").splitlines()
    assert len(shown_lines) == len(printed_lines), printed
    for one, other in zip(shown_lines, printed_lines, strict=True):
        # the slowest phases are others on other machines
        words = [NUMBER.sub("#", PHASES.sub("", line)).split() for line in (one, other)]
        assert words[0] == words[1]
        if any(word in one for word in VARYING):
            continue
        numbers = [np.array(NUMBER.findall(line), dtype=float) for line in (one, other)]
        np.testing.assert_allclose(numbers[1], numbers[0], rtol=0.02, atol=ROUNDING, err_msg=one)


@pytest.fixture(scope="module", autouse=True)
def _pictures_are_not_rendered():
    """Check the data of pictures of deformed meshes, as for demos."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(UNRENDERED), prepend=os.pathsep)
        yield


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def after_tutorial(tmp_path_factory):
    """Run the tutorial; return its variables, and the folder with its files."""
    folder = tmp_path_factory.mktemp("tutorial")
    with contextlib.chdir(folder):
        return run_blocks((DOCS / "tutorial.md").read_text()), folder


@pytest.fixture
def tutorial(after_tutorial, folder):
    """Return the tutorial's variables, with its load."""
    variables, _ = after_tutorial
    variables["force"].value[2] = -2e6
    return variables


def test_a_block_that_fails_is_an_error():
    with pytest.raises(ZeroDivisionError):
        run_blocks("Text\n\n.. code-block:: python\n\n    x = 1\n\n    x / 0\n\nMore text\n")
    with pytest.raises(ZeroDivisionError):
        run_blocks("Text\n\n```python\nx = 1\n\nx / 0\n```\n")
    with pytest.raises(subprocess.CalledProcessError):
        run_blocks(".. code-block:: console\n\n    $ python -c exit(3)\n")


@pytest.mark.parametrize("printed", ["4 cats", "3 dogs", "3 cats\n3 cats", ""])
def test_other_output_is_an_error(printed):
    check_output("3 cats", "3 cats\n")
    with pytest.raises(AssertionError):
        check_output("3 cats", printed)


def test_tutorial(after_tutorial):
    """The wall and the block carry the load, 2 MN/m^3 on 0.01 m^3."""
    variables, folder = after_tutorial
    files = {path.name for path in (folder / "results").iterdir()}
    assert {"floor.png", "floor.pvd", "block.png", "block_pressure.png"} <= files
    report = variables["problem"].report
    wall, ground = (reaction.force[2] for reaction in report.reactions)
    assert wall + ground == pytest.approx(2e4, rel=1e-8)
    assert ground == pytest.approx(report.contacts[0].normal_force, rel=1e-8)


CONTINUING = [
    "obstacles",
    "slave_and_master",
    "materials",
    "load_steps",
    "mpi",
    "report",
    "pictures",
    "convergence",
    "errors",
]
ALONE = [
    "cad_mesh",
    "impact",
    "interface_laws",
    "many_bodies",
    "mesh_error",
    "nonlinear",
    "rigid_bodies",
    "rubber",
    "self_contact",
    "sensitivities",
]


# pages on scripts of others, with the physics in their assertions
SCRIPTS = [
    "parabola",
    "circle",
    "sphere",
    "block",
    "indenter",
    "multipliers",
    "overlap",
    "beam",
    "half_disc",
    "friction",
]

RECIPES = ["fluid_pressure", "plasticity", "tape", "temperature", "wear"]


def recipe(name):
    """Run the code of a page with a test of its own; return its variables."""
    return run_blocks((DOCS / "howto" / f"{name}.md").read_text())


@pytest.mark.parametrize("page", CONTINUING)
def test_pages_that_continue_the_tutorial(page, tutorial):
    run_blocks((DOCS / "howto" / f"{page}.md").read_text(), tutorial)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.once] * (page in ("impact", "self_contact")))
        for page in ALONE
    ],
)
def test_pages_of_their_own(page, folder):
    run_blocks((DOCS / "howto" / f"{page}.md").read_text())


@pytest.mark.parametrize("page", SCRIPTS)
def test_scripts(page, folder, monkeypatch):
    """What the pages compare with is by dolfinx alone, in a module beside them."""
    monkeypatch.syspath_prepend(DOCS / "scripts")
    run_blocks((DOCS / "scripts" / f"{page}.md").read_text())


def test_temperature():
    """Pressure and flux of two bars in one dimension."""
    variables = recipe("temperature")
    force = -variables["problem"].results[0].force[0] / 0.02
    assert force == pytest.approx(variables["pressure"], rel=1e-5)
    assert variables["flux"] == pytest.approx(variables["exact"], rel=1e-5)


@pytest.mark.once
def test_wear():
    """The worn volume is k F s; in the end the pressure is that of the load."""
    variables = recipe("wear")
    way = variables["step"] * variables["distance"]
    force = 2 * variables["load"] * variables["width"]
    assert variables["volume"] == pytest.approx(variables["k"] * force * way, rel=1e-8)
    np.testing.assert_allclose(variables["p"], variables["load"], rtol=0.05)


@pytest.mark.once
def test_plasticity():
    """Stress of a step to another strain, by the formula of uniaxial strain."""
    variables = recipe("plasticity")
    assert variables["found"] == pytest.approx(variables["exact"][4.5e-3], rel=1e-4)


@pytest.mark.once
def test_fluid_pressure():
    """Without the fluid and its pressure the rest of the load makes the same contact."""
    variables = recipe("fluid_pressure")
    wet, problem, fluid = variables["wet"], variables["problem"], variables["fluid"]
    assert wet.nodal_normal_force.sum() + variables["lift"] == pytest.approx(4e4, rel=1e-8)
    variables["load"].value -= fluid
    variables["p"].x.array[:] = 0.0
    problem.solve()
    dry = problem.results[0].gather()
    np.testing.assert_array_equal(dry.active, wet.active)
    expected = np.where(dry.active, dry.pressure + fluid, 0.0)
    # the fluid ends within a facet
    np.testing.assert_allclose(wet.pressure, expected, atol=0.02 * expected.max())
    middle = wet.coordinates[:, 0] < 5e-3
    np.testing.assert_allclose(wet.pressure[middle], expected[middle], rtol=0.005)


def test_tape(folder):
    """Derivatives by pyadjoint are those of the problem itself."""
    pytest.importorskip("dolfinx_adjoint")
    variables = recipe("tape")
    u, ds = variables["problem"].u, variables["ds"]
    adjoint = variables["problem"].adjoint(1e6 * u[1] ** 2 * ds(2))
    for name in ("density", "top"):
        expected, found = adjoint.by(variables[name]), variables[f"by_{name}"].x.array
        np.testing.assert_allclose(found[: expected.size], expected, rtol=1e-6, atol=1e-9)


def test_all_pages_with_code_are_run():
    source = Path(__file__).read_text()
    pages = [
        *ROOT.glob("*.md"),
        *DOCS.glob("*.md"),
        *DOCS.glob("*.rst"),
        *(DOCS / "howto").glob("*"),
        *(DOCS / "scripts").glob("*.md"),
    ]
    for page in pages:
        if any(cell.kind == "python" for cell in literate.page_cells(page.read_text())):
            named = f'"{page.name}"' in source
            assert named or page.stem in [*CONTINUING, *ALONE, *SCRIPTS, *RECIPES], page.name


def test_readme(folder):
    """A block stands on another one, which stands on the plane: both contacts carry one force."""
    report = run_blocks((ROOT / "README.md").read_text())["problem"].report
    joint, floor = (contact.normal_force for contact in report.contacts)
    assert joint == pytest.approx(floor, rel=1e-6)
    assert [path.name for path in folder.iterdir()] == ["report.html"]


def test_solver_alone(folder, capsys):
    """The square carries its load on both corners; the membrane lies on the obstacle."""
    variables = run_blocks((DOCS / "solver_alone.rst").read_text())
    solution = variables["solution"]
    np.testing.assert_allclose(solution["normal_force"], [0.01, 0.01], rtol=1e-6)
    assert solution["active"].all()
    lower = np.searchsorted(solution["nodes"], [0, 1])
    np.testing.assert_allclose(solution["displacement"][lower, 1], -0.01, rtol=1e-12)
    assert "nodes touch the obstacle" in capsys.readouterr().out
    x, A, b = variables["result"].x, variables["A"], variables["b"]
    gradient, touching = A @ x - b, x == -0.2
    assert 100 < np.count_nonzero(touching) < 2000
    assert (x >= -0.2).all() and (gradient[touching] >= 0.0).all()
    assert np.linalg.norm(gradient[~touching]) <= 1e-7 * np.linalg.norm(b)


def test_running(folder, monkeypatch):
    """The code for load steps, with a problem of the tests."""
    scene = scenes.two_beams(MPI.COMM_SELF, "quadrilateral", 4)
    load = scene.traction
    loads = [0.5 * load.value, 1.0 * load.value]
    given = {"a": scene.a, "L": scene.L, "bcs": scene.bcs, "contacts": scene.contacts}
    given |= {"V": scene.V, "load": load, "loads": loads, "history": []}
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
    variables = run_blocks((DOCS / "running.rst").read_text(), given)
    assert variables["history"] == pytest.approx([0.5 * 6e7, 6e7], rel=1e-6)
    assert variables["residuals"]
    assert variables["begin"] == 0
    assert {"step.pvd", "state.npz", "step.html"} <= {p.name for p in Path("results").iterdir()}
    problem = ContactProblem(scene.a, scene.L, bcs=scene.bcs, contacts=given["contacts"])
    assert problem.restore("results/state.npz") == 2


def test_options(tutorial):
    """Two problems with prefixes of their own."""
    given = {key: tutorial[key] for key in ("a", "L", "bcs", "ContactProblem")}
    given |= {f"{key}_c": given[key] for key in ("a", "L", "bcs")}
    given |= {"contacts": [tutorial["pair"]], "contacts_c": [tutorial["pair"]]}
    variables = run_blocks((DOCS / "options.rst").read_text(), given)
    assert variables["problem"].options.solver.rtol == 1e-8


def test_axisymmetry(folder):
    """A cylinder of radius 1 pressed on the ground: the force is that of the whole body."""
    TOP, BOTTOM, AXIS = 1, 2, 3
    body = boxes(MPI.COMM_SELF, [Box((0, 0), (1, 1), (3, 3))], "quadrilateral")
    sides = {TOP: (1, 1.0), BOTTOM: (1, 0.0), AXIS: (0, 0.0)}
    tags = tag_facets(
        body.mesh, {t: lambda x, k=k, at=at: np.isclose(x[k], at) for t, (k, at) in sides.items()}
    )
    V = displacement_space(body.mesh)
    on_axis = fem.locate_dofs_topological(V.sub(0), 1, tags.find(AXIS))
    given = {name: getattr(fenics_tfeti, name) for name in fenics_tfeti.__all__}
    given |= {"ufl": ufl, "mesh": body.mesh, "E": 2.5, "nu": 0.25, "facet_tags": tags}
    given |= {"u": ufl.TrialFunction(V), "v": ufl.TestFunction(V), "top": TOP, "bottom": BOTTOM}
    given |= {"traction": fem.Constant(body.mesh, -1e-3)}
    given |= {"ds": ufl.Measure("ds", domain=body.mesh, subdomain_data=tags)}
    given |= {"ground": fenics_tfeti.Plane((0, 0), (0, 1))}
    given |= {"on_the_axis": fem.dirichletbc(0.0, on_axis, V.sub(0))}
    given |= {"V": V, "fem": fem, "mu": 1.0, "lmbda": 1.0}
    variables = run_blocks((DOCS / "axisymmetry.rst").read_text(), given)
    for problem in (variables["problem"], variables["finite"]):
        problem.solve()
        assert scenes.normal_forces(problem) == pytest.approx([1e-3 * np.pi], rel=1e-6)
        assert problem.results[0].pressure == pytest.approx(1e-3, rel=1e-3)


def test_friction(tutorial):
    """Contacts with friction; a load step and back, with the tutorial's block of rubber."""
    given = dict(tutorial) | {name: getattr(fenics_tfeti, name) for name in fenics_tfeti.__all__}
    contact = replace(given["pair"], friction=fenics_tfeti.Tresca(1e3))
    problem = ContactProblem(given["a"], given["L"], bcs=given["bcs"], contacts=[contact])
    given |= {"problem": problem, "load": given["force"], "full_load": np.array([0, 0, -2e6])}
    given |= {"plane": fenics_tfeti.Plane((0, 0, 0), (0, 0, 1)), "travel": 1.0, "along": np.copy}
    run_blocks((DOCS / "friction.rst").read_text(), given)
    assert problem.report.converged
    assert np.abs(problem.results[0].friction.slip).max() > 0.0


def test_periodic(folder):
    """A cell of two layers, each as long as the cell."""
    size, layers = 2.0, [Box((0, 0), (2, 1), (4, 2)), Box((0, 1), (2, 2), (4, 2))]
    bodies = boxes(MPI.COMM_SELF, layers, "quadrilateral")
    sides = [(1, 0, 0.0), (2, 0, size), (3, 1, 0.0), (4, 1, size), (5, 1, 1.0, 1), (6, 1, 1.0, 2)]
    markers = [
        (tag, lambda x, axis=axis, at=at: np.isclose(x[axis], at), *body)
        for tag, axis, at, *body in sides
    ]
    scene = scenes.Scene(bodies.mesh, tag_facets(bodies.mesh, markers, bodies.cell_tags))
    given = {name: getattr(fenics_tfeti, name) for name in fenics_tfeti.__all__}
    given |= {"np": np, "facet_tags": scene.facet_tags, "a": scene.a, "bcs": []}
    given |= {"slaves": [0], "masters": [4], "coefficients": [1.0], "offsets": [0, 1], "b": 0.1}
    space, ends = scene.V, np.append(0, np.ones(100, dtype=int))
    mpc = SimpleNamespace(function_space=space, slaves=np.array([0]), num_local_slaves=1)
    mpc.masters, mpc.coefficients = SimpleNamespace(array=[4]), lambda: (np.ones(1), ends)
    problem = run_blocks((DOCS / "howto" / "periodic.md").read_text(), given | {"mpc": mpc})[
        "problem"
    ]
    problem.solve()
    joint, side, top = problem.results
    assert 0.3 * joint.nodal_normal_force.sum() >= np.linalg.norm(joint.friction.force.sum(axis=0))
    assert top.force[1] == pytest.approx(-joint.nodal_normal_force.sum(), rel=1e-6)
    assert side.force[0] < 0.0


def test_bolts(folder):
    """A bolt through a plate on a table, all of one grid; the bolt has a thread in the table."""
    from bolts import tapped_plate

    given = {name: getattr(fenics_tfeti, name) for name in fenics_tfeti.__all__}
    given |= {name: getattr(fenics_tfeti.io, name) for name in fenics_tfeti.io.__all__}
    given |= tapped_plate()
    problem = run_blocks((DOCS / "howto" / "bolts.md").read_text(), given)["problem"]
    bolt, joint, head = (problem.results[name] for name in ("bolt", "joint", "head"))
    assert 40e3 < bolt.tension < 50e3
    assert head.nodal_normal_force.sum() == pytest.approx(bolt.tension, rel=1e-6)
    assert joint.nodal_normal_force.sum() == pytest.approx(bolt.tension - 10e3, rel=1e-6)


def draw_bolt_in_block() -> None:
    """Mesh a disc in a square, which share the nodes of the circle."""
    occ = gmsh.model.occ
    square, disc = occ.addRectangle(-2, -2, 0, 4, 4), occ.addDisk(0, 0, 0, 1, 1)
    occ.fragment([(2, square)], [(2, disc)])
    occ.synchronize()
    for name, body in (("bolt", disc), ("block", square)):
        bodies = [tag for _, tag in gmsh.model.getEntities(2) if (tag == disc) == (body == disc)]
        gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, bodies), name)


def draw_rings() -> None:
    """Mesh a disc with cells of degree 2."""
    gmsh.model.occ.addDisk(0, 0, 0, 1, 1)
    gmsh.model.occ.synchronize()
    gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, [1]), "ring")


def test_surfaces(folder):
    """Pairs, an interface that is opened, ties, and displacements of degree 2."""
    for draw, path, order in (
        (draw_bolt_in_block, "bolt_in_block.msh", 1),
        (draw_rings, "rings.msh", 2),
    ):
        with gmsh_model(path, 2, order):
            gmsh.option.setNumber("Mesh.MeshSizeMin", 0.5)
            draw()
    scene = scenes.two_beams(MPI.COMM_SELF, "quadrilateral", 2)
    given = {name: getattr(fenics_tfeti, name) for name in fenics_tfeti.__all__}
    given |= {name: getattr(fenics_tfeti.io, name) for name in fenics_tfeti.io.__all__}
    given |= {"facet_tags": scene.facet_tags, "a": scene.a, "L": scene.L, "bcs": scene.bcs}
    variables = run_blocks((DOCS / "surfaces.rst").read_text(), given)
    names = variables["parts"].names
    tags = variables["parts"].facet_tags
    assert {"bolt", "block"} <= set(names)
    assert len(tags.find(11)) == len(tags.find(12)) > 0
    degree_2 = variables["V"].dofmap.index_map.size_local
    assert degree_2 > variables["mesh"].topology.index_map(0).size_local
