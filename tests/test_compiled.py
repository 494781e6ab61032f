"""C code that is compiled when it is first used."""

import pytest

from fenics_tfeti import compiled


def test_library_in_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    """What is there is used without a lock, as in the image of a container."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (source := tmp_path / "one.c").write_text("int one(void) { return 1; }\n")

    def refused(path):
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(compiled, "_locked", refused)
        with pytest.raises(PermissionError):
            compiled.compiled_library(source)
    assert compiled.compiled_library(source).one() == 1
    monkeypatch.setattr(compiled, "_locked", refused)
    assert compiled.compiled_library(source).one() == 1
