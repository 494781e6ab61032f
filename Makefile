# `make env` prepares all that the other targets need; each of them runs it first.
PY := .venv/bin/python
SPHINXOPTS ?= -W --keep-going
N ?= 1000
RANKS ?= 1
FIRST ?= 0
# Which tests run, and on how many ranks those for several. What no other environment can change,
# and three ranks, run with Debian's dolfinx alone, unless one says otherwise:
# make test-wheel OTHERS='not heavy' OTHER_RANKS='2 3'
MARKS ?= not heavy
MPI_RANKS ?= 2 3
OTHERS ?= not heavy and not once
OTHER_RANKS ?= 2
PYTHON ?= python3

.DEFAULT_GOAL := help
.PHONY: help env env-wheel lock demo demos demo-runs dist release-check test test-wheel \
	test-debian13 test-latest test-installed fuzz verify check format docs clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /  \1\t/p' $(MAKEFILE_LIST) | expand -t 16

env:  ## install the Debian packages that are missing and fill .venv
	@tools/env.sh debian

env-wheel:  ## fill .venv-wheel with the dolfinx wheel from PyPI (Python >= 3.12)
	@tools/env.sh wheel

lock:  ## renew the versions in tools/lock that the environments install, and print what changes
	@tools/lock.sh

demo: env  ## two beams in contact; writes to results/
	$(PY) demos/two_beams.py

demos: env  ## all demos; write to results/
	for demo in demos/*.py; do $(PY) $$demo || exit 1; done

test: env  ## serial tests, then the MPI tests on 2 and 3 ranks
	@MARKS="$(MARKS)" MPI_RANKS="$(MPI_RANKS)" tools/test.sh .venv

test-wheel: env-wheel  ## what depends on the environment, with the dolfinx wheel
	@MARKS="$(OTHERS)" MPI_RANKS="$(OTHER_RANKS)" tools/test.sh .venv-wheel

test-debian13:  ## the same in Debian 13 (dolfinx 0.9), which debootstrap makes; needs root
	@tools/debian13.sh make test MARKS="$(OTHERS)" MPI_RANKS="$(OTHER_RANKS)"

test-installed:  ## the same with PYTHON, which has dolfinx and the extras test and pictures
	@MARKS="$(OTHERS)" MPI_RANKS="$(OTHER_RANKS)" tools/test.sh $(PYTHON)

test-latest:  ## the tests with the newest releases of all packages; reports, and never fails
	@tools/test-latest.sh debian
	@tools/test-latest.sh wheel

fuzz: env  ## N random problems and scenes on RANKS ranks, from seed FIRST, against what is known
	$(PY) tests/fuzz/run.py -n $(N) --ranks $(RANKS) --first $(FIRST)
	$(PY) tests/fuzz/run.py -n $(N) --ranks $(RANKS) --first $(FIRST) --level scenes

verify: env  ## the tests marked heavy, on several ranks those for them
	@MARKS=heavy MPI_RANKS="$(MPI_RANKS)" tools/test.sh .venv

check: env  ## ruff, mypy and codespell
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy --strict fenics_tfeti
	$(PY) -m codespell_lib

format: env  ## let ruff rewrite what it can
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

docs: env  ## HTML pages in docs/_build/html, with all links between them checked
	$(PY) -m sphinx -q -E -b html $(SPHINXOPTS) docs docs/_build/html
	$(PY) tools/check_links.py docs/_build/html

demo-runs: env  ## run all demos for the pages about them: output and pictures to docs/runs/
	$(PY) tools/demo_runs.py

dist: env  ## wheel and sdist in dist/
	$(PY) tools/build_dists.py dist

release-check: env  ## what wheel, sdist and recipe of conda hold
	$(PY) -m pytest tests/test_dists.py

clean:  ## remove the environments and what runs leave behind
	rm -rf .venv .venv.lock .venv-wheel .venv-wheel.lock .debian13 .debian13.lock .debian-*
	rm -rf .venv-latest .venv-latest.lock .venv-wheel-latest .venv-wheel-latest.lock
	rm -rf *.egg-info build dist docs/_build docs/_generated docs/demos/*.md docs/demos/notebooks
	rm -rf results
	rm -rf .pytest_cache .hypothesis .mypy_cache .ruff_cache
