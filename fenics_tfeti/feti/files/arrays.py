"""Files that are written whole or not at all, and named arrays in NumPy's npz format."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.typing import Array

# the entry that says what a file of arrays is
_FORMAT = "format"
# kinds of NumPy's types that an array may have, by what is asked for
_KINDS = {"integers": "iu", "numbers": "fiu", "strings": "U", "truth values": "b"}


def write_whole(path: str | os.PathLike[str], what: str, write: Callable[[BinaryIO], Any]) -> None:
    """Write a file under another name beside the target, then replace the target.

    If it cannot be written, an `OSError` names `what` is written, and the target is left as it was.
    """
    target = Path(path)
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    try:
        with errors_named(what, target):
            with part.open("xb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
    finally:
        # there only after an error, of whatever kind
        with suppress(OSError):
            part.unlink()


@contextmanager
def errors_named(what: str, path: Path) -> Iterator[None]:
    """Name what was to be written, and where, in an error of the file system."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(error.errno, f"{what} cannot be written: {reason}", str(path)) from None


@contextmanager
def folder_of(path: Path) -> Iterator[None]:
    """Create the folder of a file; folders that are new and empty after the block are removed."""
    new = [folder for folder in path.parents if not folder.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for folder in new:
            with suppress(OSError):
                folder.rmdir()


def write_arrays(
    path: str | os.PathLike[str], what: str, file_format: str, arrays: Mapping[str, Any]
) -> None:
    """Write named arrays as an npz file, or nothing; errors are those of `write_whole`.

    The entry ``format`` of the file is `file_format`: the kind of file and the version of its
    format. Names may contain slashes.
    """
    entries = {_FORMAT: np.array(file_format), **arrays}
    write_whole(path, what, lambda file: _save(file, entries))


def _save(file: BinaryIO, arrays: Mapping[str, Any]) -> None:
    # numpy.savez takes pickled objects without a word in some versions
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.save(entry, array, allow_pickle=False)


@dataclass(frozen=True)
class ArrayFile:
    """An npz file of named arrays, open for reading; arrays are read when they are asked for."""

    path: Path  # for messages
    names: frozenset[str]  # without that of the format
    archive: zipfile.ZipFile

    def read(self, name: str, kind: str, shape: tuple[int | None, ...]) -> Array:
        """Return an array of "integers", "numbers", "strings" or "truth values".

        None in the shape stands for any length. `InputError` is raised if there is no such array,
        if it is damaged, or of another kind or shape.
        """
        if name not in self.names:
            raise InputError(f"{self.path}: the array {name!r} is missing")
        array = self._read(name)
        if array.dtype.kind not in _KINDS[kind] or not array.dtype.isnative:
            raise InputError(f"{self.path}: {name!r} is of type {array.dtype}, expected {kind}")
        fits = array.ndim == len(shape) and all(
            expected in (None, n) for n, expected in zip(array.shape, shape, strict=True)
        )
        if not fits:
            expected = tuple("any" if n is None else n for n in shape)
            raise InputError(f"{self.path}: {name!r} has shape {array.shape}, expected {expected}")
        return array

    def optional(self, name: str, kind: str, shape: tuple[int | None, ...]) -> Array | None:
        """Return an array as `read` does, or None if there is no such array."""
        return self.read(name, kind, shape) if name in self.names else None

    def has_part(self, part: str) -> bool:
        """Tell whether there are arrays whose names begin with a part and a slash."""
        return any(name.startswith(f"{part}/") for name in self.names)

    def integer(self, name: str) -> int:
        """Return a single integer."""
        return int(self.read(name, "integers", ()))

    def strings(self, name: str) -> list[str]:
        """Return a list of strings; an empty array may be of any type."""
        array = self._read(name) if name in self.names else np.zeros(0)
        return [] if array.size == 0 else self.read(name, "strings", (None,)).tolist()

    def _read(self, name: str) -> Array:
        # the check sum is that of all bytes, so they are read before they are interpreted
        with _damaged(self.path, name):
            content = BytesIO(self.archive.read(f"{name}.npy"))
            array: Array = np.load(content, allow_pickle=False)
        return array


@contextmanager
def open_arrays(path: str | os.PathLike[str], file_format: str) -> Iterator[ArrayFile]:
    """Open an npz file that `write_arrays` or another program has written.

    `InputError` is raised if its entry ``format`` is not `file_format` or the file is damaged,
    `OSError` if it cannot be read.
    """
    with Path(path).open("rb") as file:
        try:
            archive = zipfile.ZipFile(file)
        except (zipfile.BadZipFile, ValueError) as error:
            raise InputError(
                f"{path}: not an npz file, or one that is cut off ({error}); expected the format "
                f"{file_format!r}"
            ) from None
        with archive:
            names = frozenset(name.removesuffix(".npy") for name in archive.namelist())
            arrays = ArrayFile(Path(path), names - {_FORMAT}, archive)
            _check_format(ArrayFile(Path(path), names, archive), file_format)
            yield arrays


def _check_format(arrays: ArrayFile, file_format: str) -> None:
    if _FORMAT not in arrays.names:
        raise InputError(f"{arrays.path}: the entry 'format' is missing, expected {file_format!r}")
    name = str(arrays.read(_FORMAT, "strings", ()))
    if name != file_format:
        raise InputError(f"{arrays.path}: the format is {name!r}, expected {file_format!r}")


@contextmanager
def _damaged(path: Path, name: str) -> Iterator[None]:
    """Say which array of which file cannot be read."""
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError, RuntimeError) as error:
        raise InputError(f"{path}: the array {name!r} is damaged: {error}") from None
