#!/usr/bin/env bash
# Print the Python >= 3.12 for the dolfinx wheel: $WHEEL_PYTHON if set, else the newest one found.
set -euo pipefail

works() {  # it starts (a pyenv shim may not), is new enough and can make environments
    "$1" -c 'import sys, ssl, venv, ensurepip; sys.exit(sys.version_info < (3, 12))' 2>/dev/null
}

if [ -n "${WHEEL_PYTHON:-}" ]; then
    candidates=("$WHEEL_PYTHON")
else
    shopt -s nullglob
    pyenv=("${HOME:-}"/.pyenv/versions/3.1[2-9]*/bin/python3)
    mapfile -t pyenv < <(printf '%s\n' "${pyenv[@]}" | sort -Vr)
    candidates=(python3.14 python3.13 python3.12 "${pyenv[@]}")
fi
for python in "${candidates[@]}"; do
    if works "$python"; then
        command -v "$python"
        exit 0
    fi
done

cat >&2 <<EOF
No Python >= 3.12 that runs (tried: ${WHEEL_PYTHON:-python3.12 to 3.14 on PATH, ~/.pyenv/versions}).
Install one (for instance 'pyenv install 3.13' or 'conda create -n py313 python=3.13'), or name it:
    make test-wheel WHEEL_PYTHON=/path/to/python3.13
EOF
exit 1
