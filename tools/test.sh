#!/usr/bin/env bash
# The tests with one Python, or that of an environment: tools/test.sh .venv
# MARKS selects tests as `pytest -m` does, MPI_RANKS lists the numbers of ranks.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$1
[ ! -d "$1" ] || python=$1/bin/python
python=$(command -v "$python")
marks=${MARKS:-not heavy}
# One thread per process and rank.
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
# Each process imports all tests: half of the time is spent on those that are not compiled yet.
export PYTHONDONTWRITEBYTECODE=
# A compilation that was interrupted leaves its C file, and FFCx waits in vain for its end.
find "${XDG_CACHE_HOME:-$HOME/.cache}/fenics" -name 'libffcx_*.c' -mmin +5 2>/dev/null |
    while read -r source; do [ -e "$source.cached" ] || rm -f "$source"; done || true

compiled() {
    { find "${XDG_CACHE_HOME:-$HOME/.cache}/fenics" -name 'libffcx_*.cached' || true; } 2>/dev/null |
        wc -l
}
before=$(compiled)

echo "== $1: serial tests"
# A file is run by one process, since its tests share what they have solved.
"$python" -m pytest tests --ignore=tests/mpi --ignore=tests/test_dists.py -m "$marks" --durations=40 \
    -n auto --maxprocesses=4 --dist=loadfile \
    --no-loadscope-reorder  # the long files first: demos, which have few tests

# The mpirun must belong to the MPI library that mpi4py loads: the environment's own, Debian's, or,
# as in FEniCS' images, that of a PETSc and MPI built from source.
for mpirun in "$(dirname "$python")/mpiexec" /usr/bin/mpirun "$(command -v mpirun || true)"; do
    [ ! -x "$mpirun" ] || break
done
options=()
color=no  # mpirun gives the ranks a terminal even where there is none
[ -t 1 ] && color=yes
if "$mpirun" --version | grep -q "Open MPI"; then
    options=(--oversubscribe --mca mpi_yield_when_idle 1)
    export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
fi
# A hang that neither pytest_ranks nor pytest-timeout ends, timeout does.
export PYTHONPATH=tools${PYTHONPATH:+:$PYTHONPATH}
for ranks in ${MPI_RANKS:-2 3}; do
    # those of tests/mpi, and those marked for this number in other files
    marked="mark\.ranks"
    [ "$ranks" -le 2 ] || marked="mark\.ranks(.*3)"
    mapfile -t files < <(grep -rl --include="test_*.py" "$marked" tests)
    echo "== $1: MPI tests on $ranks ranks"
    timeout --kill-after=20 "${MPI_TIMEOUT:-1200}" "$mpirun" "${options[@]}" -n "$ranks" \
        "$python" -m pytest -p pytest_ranks --color="$color" --timeout-method=thread --durations=20 \
        tests/mpi "${files[@]}" -m "$marks"
done
# each takes a fifth of a second, the first time
echo "== $1: $(($(compiled) - before)) forms, expressions and elements compiled"
