#!/usr/bin/env bash
# Build an environment, once: "env.sh debian" fills .venv (Debian's dolfinx), "env.sh wheel" fills
# .venv-wheel (the dolfinx wheel from PyPI). A step runs again only when what it depends on changed.
# pip installs the versions that tools/lock has for this Python; "env.sh debian latest" the newest
# ones that there are today, into .venv-latest, and "env.sh wheel latest" into .venv-wheel-latest.
set -euo pipefail
cd "$(dirname "$0")/.."

quietly() {  # run a command; show the end of its output only if it fails
    local log status=0
    log=$(mktemp)
    "$@" >"$log" 2>&1 || status=$?
    [ "$status" -eq 0 ] || tail -n 40 "$log" >&2
    rm -f "$log"
    return "$status"
}

# fill VENV PYTHON LOCK KEY "VENV OPTIONS" PIP-ARGUMENTS...
# VENV/.made and VENV/.installed hold what each step was run for, written when it has succeeded;
# VENV/lock.txt is the lock, and VENV/system.txt what Debian brought, which pip must not replace.
fill() {
    local venv=$1 python=$2 lock=$3 key=$4 options=$5 wanted
    shift 5
    [ ! -L "$venv" ] || {
        echo "$venv is a link to $(readlink "$venv"), which would be emptied: remove the link" >&2
        exit 1
    }
    exec 9>"$venv.lock" && flock 9
    key+=$'\n'$(sha256sum <"$lock")
    if [ "$(cat "$venv/.made" 2>/dev/null)" != "$key" ]; then
        echo "$venv: making it with $python"
        rm -f "$venv/.made" "$venv/.installed"
        # shellcheck disable=SC2086
        quietly "$python" -m venv --clear $options "$venv"
        echo "$key" >"$venv/.made"
    fi
    wanted=$(cat pyproject.toml tools/env.sh tools/apt-packages.txt | sha256sum)
    if [ "$(cat "$venv/.installed" 2>/dev/null)" != "$wanted" ]; then
        echo "$venv: installing the Python packages"
        rm -f "$venv/.installed"
        echo "$key" | grep == >"$venv/system.txt" || true
        cp "$lock" "$venv/lock.txt"
        # no isolation: setuptools, too, is that of the environment
        quietly "$venv/bin/python" -m pip install -c "$venv/system.txt" -c "$venv/lock.txt" \
            'setuptools>=66'
        quietly "$venv/bin/python" -m pip install -c "$venv/system.txt" -c "$venv/lock.txt" \
            --no-build-isolation "$@"
        [ "${#alone[@]}" -eq 0 ] ||
            quietly "$venv/bin/python" -m pip install -c "$venv/lock.txt" --no-deps "${alone[@]}"
        "$venv/bin/python" tools/check_env.py
        echo "$wanted" >"$venv/.installed"
    fi
}

by_hand() {
    cat >&2 <<EOF

make env: $1
Without root, with Python 3.12 or later and PyPI's dolfinx:
    make env-wheel && .venv-wheel/bin/python demos/two_beams.py
Or install the packages by hand (as root) and run 'make env' again:
    apt-get update && apt-get install -y --no-install-recommends ${missing[*]}
Or do without Debian's packages, in a conda environment:
    conda install -c conda-forge fenics-dolfinx mpich petsc4py mpi4py scipy python-gmsh pyvista
    python -m pip install --no-deps -e .
EOF
    exit 1
}

apt_packages() {
    local packages present
    mapfile -t packages < <(sed 's/#.*//' tools/apt-packages.txt | grep -o '[^[:space:]]\+')
    present=$(dpkg-query -W -f '${db:Status-Status} ${Package}\n' "${packages[@]}" 2>/dev/null || true)
    mapfile -t missing < <(for p in "${packages[@]}"; do
        grep -qx "installed $p" <<<"$present" || echo "$p"
    done)
    [ "${#missing[@]}" -gt 0 ] || return 0
    command -v apt-get >/dev/null || by_hand "this system has no apt-get"
    [ "$(id -u)" -eq 0 ] || by_hand "Debian packages are missing, and only root can install them"
    echo "apt: installing ${missing[*]}"
    export DEBIAN_FRONTEND=noninteractive
    quietly apt_install || by_hand "'apt-get' failed, see above"
}

apt_install() {  # where apt-get update fails, the install tells whether that matters
    apt-get update || true
    apt-get install -y --no-install-recommends "${missing[@]}"
}

# The lock of an environment: of its kind and the version of its Python.
lock_of() {  # KIND PYTHON
    local file
    [ -z "$latest" ] || { echo /dev/null; return; }
    file=tools/lock/$1-$("$2" -c 'import sys; print("%d.%d" % sys.version_info[:2])').txt
    [ -e "$file" ] || {
        echo "$file is missing: the newest releases are installed, with which nothing is tested" >&2
        file=/dev/null
    }
    echo "$file"
}

usage() { echo "usage: tools/env.sh debian|wheel [latest]" >&2; exit 2; }

latest=
alone=()  # what pip installs without its dependencies
case ${2:-} in
    "") ;;
    latest) latest=-latest ;;
    *) usage ;;
esac
case ${1:-} in
    debian)
        apt_packages
        python=/usr/bin/python3
        pins=$("$python" -c '
from importlib.metadata import version
for name in "numpy", "scipy", "matplotlib", "mpi4py", "petsc4py":
    print(f"{name}=={version(name)}")')
        fill ".venv$latest" "$python" "$(lock_of debian "$python")" "$PWD $("$python" --version)
$pins" --system-site-packages -e '.[dev]'
        ;;
    wheel)
        python=$(tools/find-wheel-python.sh)
        # they require the distribution fenics-dolfinx, which the wheel is not called
        alone=('dolfinx-adjoint==0.4.*' 'fenicsx-compat==0.4.*')
        fill ".venv-wheel$latest" "$python" "$(lock_of wheel "$python")" \
            "$PWD $python $("$python" --version)" "" \
            'dolfinx-solver-real==0.11.*' gmsh -e '.[test,pictures,factor,adjoint]'
        ;;
    *) usage ;;
esac
