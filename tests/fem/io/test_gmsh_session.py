"""Sessions of Gmsh leave no trace, and files that Gmsh cannot read are named."""

import signal
import sys

from mpi4py import MPI

import pytest
from msh_files import write_cell

from fenics_tfeti.errors import InputError
from fenics_tfeti.io import read_msh

gmsh = pytest.importorskip("gmsh")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no mesh file .*nowhere\.msh"):
        read_msh(tmp_path / "nowhere.msh", MPI.COMM_SELF)


def test_missing_gmsh_says_how_to_install_it(tmp_path, monkeypatch):
    path = write_cell(tmp_path / "cell.msh", "tetrahedron")
    monkeypatch.setitem(sys.modules, "gmsh", None)
    with pytest.raises(ImportError, match=r"apt install python3-gmsh.*pip install gmsh"):
        read_msh(path, MPI.COMM_SELF)


@pytest.mark.parametrize(
    "content", ["", "hello", "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 8 1 8\n"]
)
def test_damaged_file_is_refused(content, tmp_path):
    path = tmp_path / "damaged.msh"
    path.write_text(content)
    with pytest.raises(InputError, match=r"damaged\.msh"):
        read_msh(path, MPI.COMM_SELF)


def test_open_session_of_gmsh_is_kept(tmp_path):
    path = write_cell(tmp_path / "cell.msh", "tetrahedron")
    gmsh.initialize()
    try:
        gmsh.model.add("mine")
        gmsh.model.geo.addPoint(0, 0, 0)
        gmsh.model.geo.synchronize()
        models = gmsh.model.list()
        read_msh(path, MPI.COMM_SELF)
        assert gmsh.model.list() == models
        assert gmsh.model.getCurrent() == "mine"
        assert len(gmsh.model.getEntities()) == 1
        assert gmsh.option.getNumber("General.Terminal") == 1
    finally:
        gmsh.finalize()


def test_nothing_is_printed(tmp_path, capfd):
    path = write_cell(tmp_path / "cell.msh", "tetrahedron")
    for _ in range(2):
        read_msh(path, MPI.COMM_SELF)
    assert capfd.readouterr() == ("", "")


def test_handler_of_interrupts_is_kept(tmp_path):
    path = write_cell(tmp_path / "cell.msh", "tetrahedron")

    def handler(signum, frame):
        pass

    before = signal.signal(signal.SIGINT, handler)
    try:
        read_msh(path, MPI.COMM_SELF)
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_nothing_is_asked_outside_a_session(tmp_path, monkeypatch):
    """Gmsh 4.8 may end the process then: whether errors do that has no value before a session."""
    path = write_cell(tmp_path / "cell.msh", "tetrahedron")
    open_sessions = []
    initialize, finalize = gmsh.initialize, gmsh.finalize

    def opened(*args, **kwargs):
        initialize(*args, **kwargs)
        open_sessions.append(1)

    def closed():
        finalize()
        open_sessions.pop()

    def asked(name):
        def function(*args):
            assert open_sessions
            return original(*args)

        original = getattr(gmsh.option, name)
        return function

    monkeypatch.setattr(gmsh, "initialize", opened)
    monkeypatch.setattr(gmsh, "finalize", closed)
    for name in ("getNumber", "getString"):
        monkeypatch.setattr(gmsh.option, name, asked(name))
    read_msh(path, MPI.COMM_SELF)
    assert not open_sessions
