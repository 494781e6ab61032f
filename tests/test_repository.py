"""What the files for visitors and services say is there: targets, files, versions."""

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.once

ROOT = Path(__file__).parent.parent
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "docs" / "install.md"]


@pytest.mark.parametrize("path", [*WORKFLOWS, *TEXTS], ids=lambda path: path.name)
def test_targets_are_those_of_the_makefile(path):
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^([a-z0-9-]+):", makefile, re.M))
    used = set(
        re.findall(r"^(?:\s*- run: )?make ([a-z0-9-]+)|`make ([a-z0-9-]+)", path.read_text(), re.M)
    )
    named = {name for names in used for name in names if name}
    assert named and named <= targets


@pytest.mark.parametrize(
    "path", [ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=lambda p: p.name
)
def test_links_lead_to_files(path):
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", path.read_text())
    assert links
    assert [link for link in links if not (ROOT / link).is_file()] == []


def test_workflows_run_the_versions_of_the_table():
    rows = re.findall(r"^\| (0\.\d+)\.\d+ \|", (ROOT / "docs" / "supported.md").read_text(), re.M)
    workflow = (ROOT / ".github" / "workflows" / "tests.yml").read_text()
    assert rows[0] == "0.5"  # Debian 12
    for name, versions in (("docker", r'"(0\.\d+)\.\d+"'), ("conda", r'"(0\.\d+)"')):
        job = workflow.split(f"\n  {name}:")[1].split("steps:")[0]
        assert re.findall(versions, job) == rows[1:]
