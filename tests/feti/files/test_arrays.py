"""Files are whole or not there, and what is wrong with one is named."""

import resource
import zipfile

import numpy as np
import pytest

from fenics_tfeti import InputError
from fenics_tfeti.feti.files.arrays import open_arrays, write_arrays, write_whole

KIND = "test 1"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "arrays.npz"


def write(path, **arrays):
    write_arrays(path, "the test", KIND, arrays)


def read(path, name, kind="numbers", shape=(None,)):
    with open_arrays(path, KIND) as file:
        return file.read(name, kind, shape)


def test_arrays_are_the_same(path):
    """Numpy reads what is written, and what it writes is read."""
    arrays = {"a/b": np.arange(3), "c": np.array([[0.5, np.inf]]), "d": np.array(["x", "yz"])}
    write_arrays(path, "the test", KIND, arrays)
    assert dict(np.load(path)).keys() == {"format", "a/b", "c", "d"}
    for _ in range(2):
        with open_arrays(path, KIND) as file:
            assert file.names == {"a/b", "c", "d"}
            np.testing.assert_array_equal(file.read("a/b", "integers", (3,)), [0, 1, 2])
            np.testing.assert_array_equal(file.read("c", "numbers", (None, 2)), [[0.5, np.inf]])
            assert file.strings("d") == ["x", "yz"]
            assert file.strings("e") == []
        np.savez_compressed(path, format=np.array(KIND), **arrays)


@pytest.mark.parametrize(("name", "kind", "shape", "message"), [
    ("b", "numbers", (None,), "the array 'b' is missing"),
    ("a", "integers", (None,), "of type float64, expected integers"),
    ("a", "strings", (None,), "of type float64, expected strings"),
    ("a", "numbers", (4,), r"shape \(3,\), expected \(4,\)"),
    ("a", "numbers", (None, 2), r"shape \(3,\), expected \('any', 2\)"),
])  # fmt: skip
def test_wrong_array_is_named(path, name, kind, shape, message):
    write(path, a=np.arange(3.0))
    with pytest.raises(InputError, match=message) as caught:
        read(path, name, kind, shape)
    assert str(path) in str(caught.value)


def test_other_formats_are_refused(path):
    with pytest.raises(FileNotFoundError):
        read(path, "a")
    write_arrays(path, "the test", "another 7", {"a": np.zeros(1)})
    with pytest.raises(InputError, match="the format is 'another 7', expected 'test 1'"):
        read(path, "a")
    np.savez(path, a=np.zeros(1))
    with pytest.raises(InputError, match="'format' is missing"):
        read(path, "a")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("format.npy", b"fenics_tfeti")
    with pytest.raises(InputError, match="'format' is damaged"):
        read(path, "a")
    for content in (b"", b"no archive", np.arange(9.0).tobytes()):
        path.write_bytes(content)
        with pytest.raises(InputError, match="not an npz file"):
            read(path, "a")


def test_file_that_is_cut_off_or_changed_is_refused(path):
    write(path, a=np.arange(1000.0))
    whole = bytearray(path.read_bytes())
    for length in (len(whole) - 1, len(whole) // 2, 40):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match="cut off"):
            read(path, "a")
    # in the numbers, and in the array's own header
    for at in (len(whole) // 2, whole.rindex(b"descr")):
        changed = whole.copy()
        changed[at] ^= 1
        path.write_bytes(changed)
        with pytest.raises(InputError, match="'a' is damaged"):
            read(path, "a")


def test_objects_are_neither_written_nor_read(path):
    with pytest.raises(ValueError, match="Object arrays"):
        write(path, a=np.array([{}]))
    np.savez(path, format=np.array(KIND), a=np.array([{}]))
    with pytest.raises(InputError, match="'a' is damaged: Object arrays"):
        read(path, "a")


def test_full_disk_leaves_the_old_file(path):
    """The limit on the size of files stands for the disk: the system refuses to write on."""
    write(path, a=np.arange(3.0))
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(OSError, match="the test cannot be written: File too large") as caught:
            write(path, a=np.arange(10_000.0))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caught.value.filename == str(path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_error_while_writing_leaves_the_old_file(path):
    path.write_bytes(b"old")

    def fail(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(path, "the test", fail)
    assert path.read_bytes() == b"old"
    assert [p.name for p in path.parent.iterdir()] == [path.name]
