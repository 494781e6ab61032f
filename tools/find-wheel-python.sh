#!/usr/bin/env bash
# Print the Python >= 3.12 for the dolfinx wheel: $WHEEL_PYTHON if set, else the first one found, 3.13
# before others, since it is tested with; with --all one of each version.
set -euo pipefail

works() {  # it starts (a pyenv shim may not), is new enough and can make environments
    "$1" -c 'import sys, ssl, venv, ensurepip; sys.exit(sys.version_info < (3, 12))' 2>/dev/null
}

if [ -n "${WHEEL_PYTHON:-}" ]; then
    candidates=("$WHEEL_PYTHON")
else
    shopt -s nullglob
    pyenv=("${HOME:-}"/.pyenv/versions/3.1{3,2,[4-9]}*/bin/python3)
    candidates=(python3.13 python3.12 "${pyenv[@]}" python3.14)
fi
versions=
for python in "${candidates[@]}"; do
    works "$python" || continue
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    [[ " $versions " != *" $version "* ]] || continue
    versions+=" $version"
    command -v "$python"
    [ "${1:-}" = --all ] || break
done
[ -z "$versions" ] || exit 0

cat >&2 <<EOF
No Python >= 3.12 that runs (tried: ${WHEEL_PYTHON:-python3.12 to 3.14 on PATH, ~/.pyenv/versions}).
Install one (for instance 'pyenv install 3.13' or 'conda create -n py313 python=3.13'), or name it:
    make test-wheel WHEEL_PYTHON=/path/to/python3.13
EOF
exit 1
