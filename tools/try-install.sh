#!/usr/bin/env bash
# Try the lines of docs/install.md in clean environments:
#     [PAGES=1] tools/try-install.sh [pypi] [debian12] [debian13]
# By default those that can run on this machine. The sdist is unpacked, and the lines are run in its
# folder; then the self-test on one and two processes, and a demo, whose mesh the sdist has. With PAGES
# the code of all pages runs there, too, and has to print what they show.
set -euo pipefail
cd "$(dirname "$0")/.."

# The commands under a heading of docs/install.md.
lines_of() {
    sed -n "/^## $1/,/^## /p" docs/install.md | sed -n '/^```text/,/^```/p' | grep -v '^```'
}

# Run commands in an unpacked sdist, then try what they have installed.
try() {  # NAME HEADING
    local folder status=0
    folder=$(mktemp -d)
    tar -xzf "$dists"/*.tar.gz --strip-components=1 -C "$folder"
    lines_of "$2" >"$folder/lines.sh"
    [ -s "$folder/lines.sh" ] || { echo "no lines under '$2' in docs/install.md" >&2; exit 1; }
    cat >>"$folder/lines.sh" <<'EOF'
export OMP_NUM_THREADS=1 OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
cd demos  # away from the sources, so that the installed package is imported
python -m fenics_tfeti
more=$(mpirun --version | grep -q "Open MPI" && echo --oversubscribe || true)
mpirun $more -n 2 python -m fenics_tfeti | tee two.log
grep -q "processes  2" two.log
python two_beams.py
test -s results/two_beams_pressure.png
python -c "import fenics_tfeti; print(fenics_tfeti.__file__)" | grep -q site-packages
if [ -n "${PAGES:-}" ]; then
    cd ..
    pip install pytest pytest-timeout scikit-fem nbformat hypothesis \
        "numpy==$(python -c 'import numpy; print(numpy.__version__)')"
    python -P -m pytest -q tests/test_docs_code.py  # -P: not the sources, but what is installed
fi
EOF
    echo "==== $1"
    (cd "$folder" && env -u PYTHONPATH -u VIRTUAL_ENV bash -exo pipefail lines.sh) || status=$?
    rm -rf "$folder"
    [ "$status" -eq 0 ] || { echo "==== $1: FAILED" >&2; exit 1; }
    echo "==== $1: works"
}

pypi() {
    local python
    python=$("$(tools/find-wheel-python.sh)" -c 'import sys; print(sys.executable)')
    PATH="$(dirname "$python"):$PATH" try pypi "PyPI"
}

# Debian's packages are there if dolfinx is; only a system of our own gets them by apt.
debian12() { lines_without_apt; PATH=/usr/bin:$PATH try debian12 "Debian 12 and 13"; }

debian13() { tools/debian13.sh tools/try-install.sh --inside-debian13; }

lines_without_apt() {
    eval "$(declare -f lines_of | sed '1s/lines_of/all_lines_of/')"
    lines_of() { all_lines_of "$1" | grep -v '^apt '; }
}

release() { sed -n 's/^VERSION_ID="\(.*\)"/\1/p' /etc/os-release; }

has_dolfinx() { /usr/bin/python3 -c 'import dolfinx' 2>/dev/null; }

build() {  # with any Python that has setuptools and wheel
    dists=$(mktemp -d)
    trap 'rm -rf "$dists"' EXIT
    python3 -m venv "$dists/venv"
    "$dists/venv/bin/python" -m pip install -q setuptools wheel
    "$dists/venv/bin/python" tools/build_dists.py "$dists"
}

targets=("$@")
if [ $# -eq 0 ]; then
    ! tools/find-wheel-python.sh >/dev/null 2>&1 || targets+=(pypi)
    ! { [ "$(release)" = 12 ] && has_dolfinx; } || targets+=(debian12)
    [ -n "$(tools/debian13.sh --check)" ] || targets+=(debian13)
fi
for target in "${targets[@]}"; do
    case $target in
        pypi | debian12) [ -n "${dists:-}" ] || build; "$target" ;;
        debian13) debian13 ;;
        --inside-debian13)  # a system of our own: apt as well, which asks nothing
            echo 'APT::Get::Assume-Yes "true";' >/etc/apt/apt.conf.d/90assume-yes
            export DEBIAN_FRONTEND=noninteractive
            apt-get update
            command -v python3 >/dev/null || apt-get install python3-venv
            build
            try debian13 "Debian 12 and 13"
            ;;
        *) echo "usage: tools/try-install.sh [pypi] [debian12] [debian13]" >&2; exit 2 ;;
    esac
done
