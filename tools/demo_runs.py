"""Run demos and pages that draw, and keep what the documentation shows of it: `make demo-runs`.

What a script prints goes to docs/runs/<name>/output.txt, its pictures beside it, scaled down, and
its animations as they are.
With names as arguments only these are run: python tools/demo_runs.py tutorial cam
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "docs"))
import literate

PAGES = ROOT / "docs" / "scripts"

WIDTH = 1200  # pixels
COLOURS = 256


def run(script: Path, kept: Path) -> None:
    """Run a script in a folder of its own, and keep its output and pictures."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(PAGES)])}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(script)]
        done = subprocess.run(
            command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=True
        )
        kept.mkdir(parents=True, exist_ok=True)
        for old in kept.iterdir():
            old.unlink()
        (kept / "output.txt").write_text(done.stdout)
        for picture in sorted(Path(folder).glob("results/*.png")):
            shrink(picture, kept / picture.name)
        for animation in sorted(Path(folder).glob("results/*.gif")):
            shutil.copy(animation, kept)


def shrink(picture: Path, kept: Path) -> None:
    """Write a picture with few colours, and no wider than a page."""
    image = Image.open(picture).convert("RGB")
    if image.width > WIDTH:
        height = round(image.height * WIDTH / image.width)
        image = image.resize((WIDTH, height), Image.Resampling.LANCZOS)
    # an octree keeps the colours of small areas, such as those of a colour bar
    few = image.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    few.save(kept, optimize=True)


def main(names: list[str]) -> None:
    """Run the scripts with these names, or all of them."""
    with tempfile.TemporaryDirectory() as folder:
        scripts = sorted((ROOT / "demos").glob("*.py"))
        for page in [ROOT / "docs" / "tutorial.md", *PAGES.glob("*.md")]:
            if "runs/" in page.read_text():
                scripts.append(Path(folder) / f"{page.stem}.py")
                scripts[-1].write_text(literate.script_of(page.read_text(), page.stem))
        for script in scripts:
            if not names or script.stem in names:
                print(script.name, flush=True)
                run(script, ROOT / "docs" / "runs" / script.stem)


if __name__ == "__main__":
    main(sys.argv[1:])
