"""The scripts in meshes/ make the files that the demos read."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.heavy, pytest.mark.once]

pytest.importorskip("gmsh")

MESHES = Path(__file__).parents[2] / "meshes"
OTHERS = {
    "hertz_ball_hexahedra": ("half_balls", "--output", "{output}"),
    "punch_disc": ("half_space", "--divisions", "6", "--output", "{output}"),
    "punch_strip": (
        *("half_space", "--cell", "quadrilateral", "--divisions", "16"),
        *("--output", "{output}"),
    ),
    "pile_of_cylinders": ("pile_of_cylinders", "--elements", "16", "--output", "{output}"),
    "pile_of_cylinders_3d": (
        *("pile_of_cylinders", "--dim", "3", "--elements", "4"),
        *("--output", "{output}"),
    ),
}
OWN = {
    path.stem: (path.stem, "--output", "{output}")
    for path in sorted(MESHES.glob("*.msh"))
    if path.with_suffix(".py").exists()
}


def names_and_nodes(path: Path) -> tuple[list[str], int]:
    """Return the lines of the physical names, and the number of nodes."""
    lines = path.read_text().splitlines()
    first, end = (lines.index(line) for line in ("$PhysicalNames", "$EndPhysicalNames"))
    # entity blocks, nodes, and the smallest and largest number
    return sorted(lines[first + 1 : end]), int(lines[lines.index("$Nodes") + 1].split()[1])


@pytest.mark.parametrize("mesh", OWN | OTHERS)
def test_script_makes_the_mesh(mesh, tmp_path):
    """With the names, and about as many nodes; other versions of Gmsh mesh otherwise."""
    script, *arguments = (OWN | OTHERS)[mesh]
    output = tmp_path / "a.msh"
    command = [argument.format(output=output) for argument in arguments]
    subprocess.run([sys.executable, MESHES / f"{script}.py", *command], check=True, timeout=250)
    names, nodes = names_and_nodes(output)
    kept_names, kept_nodes = names_and_nodes(MESHES / f"{mesh}.msh")
    assert names == kept_names
    assert nodes == pytest.approx(kept_nodes, rel=0.1)
