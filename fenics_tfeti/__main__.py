"""``python -m fenics_tfeti``: what the installation has, and a self-test."""

from __future__ import annotations

import sys

from fenics_tfeti.installation import main

sys.exit(main())
