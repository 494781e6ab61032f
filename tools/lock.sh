#!/usr/bin/env bash
# Renew the files in tools/lock and print what changes:
#     tools/lock.sh [debian] [wheel] [debian13]
# By default all that this machine can make. Each file holds what pip resolves today for one
# environment, without the packages of the system; the environments are made anew for it. For the
# wheel of dolfinx this is done with each Python that could run it.
set -euo pipefail
cd "$(dirname "$0")/.."

# What pip installed into an environment, but for the project itself.
frozen() {
    "$1/bin/python" -m pip list --local --format=freeze |
        grep -viE '^(fenics[-_]tfeti|pip)==' | LC_ALL=C sort -f
}

renew() {  # KIND VENV
    local file
    rm -rf "$2"
    tools/env.sh "$1" latest
    file=tools/lock/$1-$("$2/bin/python" -c 'import sys; print("%d.%d" % sys.version_info[:2])').txt
    mkdir -p tools/lock
    [ -e "$file" ] || touch "$file"
    frozen "$2" >"$file.new"
    echo "== $file"
    { diff --unified=0 "$file" "$file.new" || true; } | grep '^[-+][^-+]' || echo "nothing changes"
    mv "$file.new" "$file"
}

wheel() {
    local python
    for python in $(tools/find-wheel-python.sh --all); do
        WHEEL_PYTHON=$python renew wheel .venv-wheel-latest
    done
}

# The copy of the project in Debian 13 keeps its environments, but not its files.
debian13() {
    tools/debian13.sh tools/lock.sh debian
    cp .debian13/root/project/tools/lock/debian-3.13.txt tools/lock/
}

targets=("$@")
if [ $# -eq 0 ]; then
    targets=(debian)
    ! tools/find-wheel-python.sh >/dev/null 2>&1 || targets+=(wheel)
    [ -n "$(tools/debian13.sh --check)" ] || targets+=(debian13)
fi
for target in "${targets[@]}"; do
    case $target in
        debian) renew debian .venv-latest ;;
        wheel | debian13) "$target" ;;
        *) echo "usage: tools/lock.sh [debian] [wheel] [debian13]" >&2; exit 2 ;;
    esac
done
