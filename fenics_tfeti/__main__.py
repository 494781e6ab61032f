"""``python -m fenics_tfeti``: what the installation has, and a self-test."""

from __future__ import annotations

import sys

from fenics_tfeti.errors import needs_fenicsx

try:
    with needs_fenicsx("python -m fenics_tfeti"):
        from fenics_tfeti.installation import main
except ImportError as error:
    sys.exit(str(error))

sys.exit(main())
