#!/usr/bin/env bash
# Install Debian's Chromium, in which the tests open pages, if it is missing; without it they are
# skipped and say so. No other target needs it.
set -euo pipefail

command -v chromium >/dev/null || command -v chromium-browser >/dev/null && exit 0
command -v apt-get >/dev/null || { echo "no Chromium, and no apt-get" >&2; exit 1; }
[ "$(id -u)" -eq 0 ] || { echo "no Chromium, and only root can install it" >&2; exit 1; }
export DEBIAN_FRONTEND=noninteractive
log=$(mktemp)
trap 'rm -f "$log"' EXIT
{ apt-get update || true; apt-get install -y --no-install-recommends chromium; } >"$log" 2>&1 || {
    tail -n 20 "$log" >&2
    exit 1
}
