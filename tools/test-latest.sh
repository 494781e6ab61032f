#!/usr/bin/env bash
# Run the tests with the newest releases of all packages that pip installs, in a new environment,
# and report: tools/test-latest.sh debian|wheel. Locks are not used, and failures are no error.
set -euo pipefail
cd "$(dirname "$0")/.."
declare -A venvs=([debian]=.venv-latest [wheel]=.venv-wheel-latest)
venv=${venvs[$1]}

rm -rf "$venv"
tools/env.sh "$1" latest
"$venv/bin/python" tools/check_lock.py "$1"
if tools/test.sh "$venv"; then
    echo "== $venv: passed with the newest releases"
else
    echo "== $venv: FAILED with the newest releases"
fi
