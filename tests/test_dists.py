"""The wheel and the sdist have all files; run by `make release-check`."""

import re
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tools"))
from build_dists import build, project_files


@pytest.fixture(scope="module")
def dists(tmp_path_factory):
    return build(tmp_path_factory.mktemp("dists"))


def test_wheel(dists):
    """All of the package, with the files of its pages, and nothing else."""
    with zipfile.ZipFile(dists[0]) as wheel:
        names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert names == {name for name in project_files() if name.startswith("fenics_tfeti/")}
    assert {"fenics_tfeti/fem/io/page.css", "fenics_tfeti/feti/factors/supernodal.c"} <= names


def test_sdist(dists):
    """All files of the project: with what each demo needs."""
    with tarfile.open(dists[1]) as sdist:
        paths = [Path(entry.name) for entry in sdist if entry.isfile()]
    names = {path.relative_to(path.parts[0]).as_posix() for path in paths}
    added = {"PKG-INFO", "setup.cfg"}
    names = {name for name in names - added if ".egg-info/" not in name}
    assert names == set(project_files())
    for demo in (ROOT / "demos").glob("*.py"):
        meshes = re.findall(r'"(\w+\.msh)"', demo.read_text())
        assert {f"meshes/{mesh}" for mesh in meshes} <= names, demo.name


def test_metadata(dists):
    """The version, and the extra that brings dolfinx."""
    with zipfile.ZipFile(dists[0]) as wheel:
        (name,) = (name for name in wheel.namelist() if name.endswith("/METADATA"))
        metadata = wheel.read(name).decode()
    (version,) = re.findall(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.M)
    assert f"\nVersion: {version}\n" in metadata
    assert dists[1].name == f"fenics_tfeti-{version}.tar.gz"
    needed = re.findall(r"^Requires-Dist: dolfinx-solver-real.*$", metadata, re.MULTILINE)
    assert len(needed) == 1 and "3.12" in needed[0] and "extra == " in needed[0]


def test_versions_are_one():
    """That of the package, of its citation, and of the changes that are listed first."""
    (version,) = re.findall(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.M)
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^## \[(.+)\]", (ROOT / "CHANGELOG.md").read_text(), re.M)[0] == version


def test_conda_recipe():
    """It has the version of the package, and what conda's packages of FEniCSx do not bring."""
    recipe = (ROOT / "recipe" / "recipe.yaml").read_text()
    project = (ROOT / "pyproject.toml").read_text()
    (version,) = re.findall(r'^version = "(.+)"$', project, re.MULTILINE)
    assert f"\n  version: {version}\n" in recipe
    (dependencies,) = re.findall(r"^dependencies = \[(.+)\]$", project, re.MULTILINE)
    for name in re.findall(r'"([\w-]+)', dependencies):
        assert f"\n    - {name}\n" in recipe
