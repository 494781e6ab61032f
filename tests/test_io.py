"""`fenics_tfeti.io` has the public names of `fem.io`, and only its import loads dolfinx."""

from new_process import run_python

import fenics_tfeti.io


def test_names_are_those_of_fem_io():
    for name in fenics_tfeti.io.__all__:
        assert getattr(fenics_tfeti.io, name).__module__.startswith("fenics_tfeti.fem.io.")


def test_import_of_the_package_does_not_load_dolfinx():
    run_python("import sys, fenics_tfeti; assert 'dolfinx' not in sys.modules")


def test_import_of_io_loads_no_optional_library():
    run_python(
        "import sys, fenics_tfeti.io\n"
        "assert not {'gmsh', 'pyvista', 'matplotlib'} & set(sys.modules)"
    )
