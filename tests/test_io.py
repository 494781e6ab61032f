"""`fenics_tfeti.io` has the public names of `fem.io`, and only its import loads dolfinx."""

from __future__ import annotations

import subprocess
import sys

import fenics_tfeti.fem.io
import fenics_tfeti.io


def test_names_are_those_of_fem_io():
    assert fenics_tfeti.io.__all__ == fenics_tfeti.fem.io.__all__
    for name in fenics_tfeti.io.__all__:
        assert getattr(fenics_tfeti.io, name) is getattr(fenics_tfeti.fem.io, name)


def test_import_of_the_package_does_not_load_dolfinx():
    code = "import sys, fenics_tfeti; assert 'dolfinx' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_import_of_io_loads_no_optional_library():
    code = (
        "import sys, fenics_tfeti.io\n"
        "assert not {'gmsh', 'pyvista', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
