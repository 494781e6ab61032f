"""The documentation lists all options with their defaults; the citation has the version."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

from fenics_tfeti.feti import Options
from fenics_tfeti.options import ContactOptions

pytestmark = pytest.mark.once

ROOT = Path(__file__).parent.parent


def test_all_options_with_their_defaults():
    text = (ROOT / "docs" / "options.rst").read_text()
    listed = dict(re.findall(r"^   \* - ``(\w+)``\n     - (.+)$", text, re.MULTILINE))
    given = [f for kind in (Options, ContactOptions) for f in fields(kind) if f.name != "solver"]
    assert set(listed) == {f.name for f in given}
    for f in given:
        if isinstance(f.default, bool):
            assert listed[f.name] == str(f.default).lower()
        elif isinstance(f.default, str):
            assert listed[f.name] == f'``"{f.default}"``'
        else:
            assert float(listed[f.name].replace(" ", "")) == f.default


def test_citation_has_the_version_of_the_package():
    (cited,) = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    (made,) = re.findall(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert cited == made
