"""Pytest plugin and first import for runs as if petsc4py were not installed.

Use: ``python -m pytest -p without_petsc tests`` with this folder on PYTHONPATH.
"""

import sys

sys.modules["petsc4py"] = None
