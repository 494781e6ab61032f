"""Write the messages of the mistakes into docs/howto/errors.md; run this file after a change."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

from mpi4py import MPI

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from fenics_tfeti import ContactError
from mistakes import MISTAKES

PAGE = Path(__file__).parents[3] / "docs" / "howto" / "errors.md"
BELOW = "<!-- From here on written by tests/support/mistakes/page.py -->\n"
TITLES = {
    "forms": "Forms",
    "supports": "Supports",
    "meshes": "The mesh",
    "contacts": "Contact pairs and obstacles",
    "pairing": "Partners, gaps and normals",
    "bodies": "Rigid bodies, bolts, periodic surfaces",
    "arguments": "Other arguments",
}


def page() -> str:
    """Return the page with the message of each mistake, by subject."""
    messages: dict[str, dict[str, str]] = {title: {} for title in TITLES.values()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for mistake in MISTAKES:
            try:
                mistake.pose(MPI.COMM_SELF)
            except ContactError as error:
                subject = messages[TITLES[mistake.pose.__module__.split(".")[-1]]]
                name = mistake.name.replace("_", " ").replace("nan", "NaN")
                # the same message twice is explained by its first mistake
                subject.setdefault(f"`{error}`", name[0].upper() + name[1:])
    head = PAGE.read_text().split(BELOW)[0]
    sections = [
        "\n".join([f"\n## {title}\n", *(f"{name}\n: {text}\n" for text, name in subject.items())])
        for title, subject in messages.items()
    ]
    return head + BELOW + "".join(sections)


if __name__ == "__main__":
    PAGE.write_text(page())
