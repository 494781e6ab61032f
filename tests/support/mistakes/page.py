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


def page() -> str:
    """Return the page with the message of each mistake, by subject."""
    messages: dict[str, dict[str, str]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for mistake in MISTAKES:
            try:
                mistake.pose(MPI.COMM_SELF)
            except ContactError as error:
                subject = messages.setdefault(mistake.subject, {})
                # the same message twice is explained by its first mistake
                subject.setdefault(f"`{error}`", mistake.name[0].upper() + mistake.name[1:])
    head = PAGE.read_text().split(BELOW)[0]
    sections = [
        "\n".join(
            [
                f"\n:::{{dropdown}} {title}\n",
                *(f"{name}\n: {text}\n" for text, name in subject.items()),
                ":::\n",
            ]
        )
        for title, subject in messages.items()
    ]
    return head + BELOW + "".join(sections)


if __name__ == "__main__":
    PAGE.write_text(page())
