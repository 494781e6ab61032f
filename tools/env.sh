#!/usr/bin/env bash
# Build an environment, once: "env.sh debian" fills .venv (Debian's dolfinx), "env.sh wheel" fills
# .venv-wheel (the dolfinx wheel from PyPI). A step runs again only when what it depends on changed.
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

# fill VENV PYTHON KEY "VENV OPTIONS" PIP-ARGUMENTS...
# VENV/.made and VENV/.installed hold what each step was run for, written when it has succeeded.
fill() {
    local venv=$1 python=$2 key=$3 options=$4 wanted
    shift 4
    exec 9>"$venv.lock" && flock 9
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
        # what Debian brought must not be replaced, so pip sees it as fixed
        echo "$key" | grep == >"$venv/constraints.txt" || true
        quietly "$venv/bin/python" -m pip install -c "$venv/constraints.txt" "$@"
        "$venv/bin/python" tools/check_env.py
        echo "$wanted" >"$venv/.installed"
    fi
}

by_hand() {
    cat >&2 <<EOF

make env: $1
Install the packages by hand (as root) and run 'make env' again:
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

case ${1:-} in
    debian)
        apt_packages
        pins=$(/usr/bin/python3 -c '
from importlib.metadata import version
for name in "numpy", "scipy", "matplotlib", "mpi4py", "petsc4py":
    print(f"{name}=={version(name)}")')
        fill .venv /usr/bin/python3 "$PWD $(/usr/bin/python3 --version)
$pins" --system-site-packages --no-build-isolation -e '.[dev]'
        ;;
    wheel)
        python=$(tools/find-wheel-python.sh)
        fill .venv-wheel "$python" "$PWD $python $("$python" --version)" "" \
            'dolfinx-solver-real==0.11.*' gmsh -e '.[test,pictures,factor]'
        ;;
    *)
        echo "usage: tools/env.sh debian|wheel" >&2
        exit 2
        ;;
esac
