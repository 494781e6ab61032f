"""Build the wheel and the sdist of the project: python tools/build_dists.py FOLDER

They are built from a copy of the project's files, so that nothing that runs leave behind gets into
them.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
_BUILD = "import sys, setuptools.build_meta as b; b.build_{}(sys.argv[1])"
_FOLDERS = (
    ".ci",
    ".github",
    "benchmarks",
    "demos",
    "docs",
    "fenics_tfeti",
    "meshes",
    "paper",
    "recipe",
    "tests",
    "tools",
)
_GENERATED = ("docs/_build/", "docs/_generated/", "docs/demos/notebooks/")


def project_files() -> list[str]:
    """Return the project's files: those of the repository, or of a copy of it without Git."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    if (ROOT / ".git").exists():
        listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
        names = listed.stdout.rstrip("\0").split("\0")
        return sorted(name for name in names if (ROOT / name).is_file())
    paths = [p for p in ROOT.iterdir() if p.is_file() and p.suffix not in (".lock", ".log")]
    paths += [p for folder in _FOLDERS for p in (ROOT / folder).rglob("*") if p.is_file()]
    names = [p.relative_to(ROOT).as_posix() for p in paths if "__pycache__" not in p.parts]
    return sorted(
        name
        for name in names
        if not name.startswith(_GENERATED)
        and not (name.startswith("docs/demos/") and name.endswith(".md"))
    )


def build(output: Path) -> tuple[Path, Path]:
    """Build both into a folder; return the paths of the wheel and of the sdist."""
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in project_files():
            target = Path(folder) / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)
        for kind in ("wheel", "sdist"):
            command = [sys.executable, "-c", _BUILD.format(kind), str(output.resolve())]
            environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True
            )
            if done.returncode:
                raise RuntimeError(f"building the {kind} failed:\n{done.stdout}{done.stderr}")
    (wheel,), (sdist,) = output.glob("*.whl"), output.glob("*.tar.gz")
    return wheel, sdist


if __name__ == "__main__":
    for path in build(Path(sys.argv[1])):
        print(path)
