#!/usr/bin/env bash
# Run a command on a copy of the project in Debian 13, which has dolfinx 0.9, or in another release:
#     [DEBIAN=sid] tools/debian13.sh make test
# "tools/debian13.sh --check" prints why this machine cannot do it, or nothing.
#
# debootstrap makes the system in .debian13/ (.debian-sid/) the first time, and again when this file
# changes.
# Mounts and processes are in namespaces of their own: when the command ends, fails or is
# interrupted, none is left, so that the folder can be deleted at any time.
set -euo pipefail
cd "$(dirname "$0")/.."
readonly release=${DEBIAN:-trixie}
home=$PWD/.debian-$release
[ "$release" != trixie ] || home=$PWD/.debian13
readonly home
readonly root=$home/root
key=$(sha256sum tools/debian13.sh)

made() { [ "$(cat "$home/made" 2>/dev/null)" = "$key" ]; }

# Run a command whose mounts and processes end with it, however it ends.
isolated() {
    setpriv --pdeathsig KILL unshare --mount --pid --kill-child -- "$@" &
    # shellcheck disable=SC2064
    trap "kill -KILL $! 2>/dev/null; exit 130" INT TERM HUP
    wait $!
}

# The mirror of this machine's packages. Nothing if it is not a Debian: debootstrap has a default.
mirror() {
    # shellcheck disable=SC2016
    apt-get indextargets --format '$(ORIGIN) $(CODENAME) $(COMPONENT) $(REPO_URI)' 2>/dev/null |
        awk -v name="$(sed -n 's/^VERSION_CODENAME=//p' /etc/os-release)" \
            '$1 == "Debian" && $2 == name && $3 == "main" { sub("/$", "", $4); print $4; exit }'
}

# Print why this machine cannot run that Debian, or nothing.
obstacle() {
    [ "$(id -u)" -eq 0 ] || { echo "only root can"; return; }
    command -v debootstrap apt-get >/dev/null || { echo "there is no debootstrap"; return; }
    permitted || { echo "mount or mknod is not permitted"; return; }
    made || answers "$(mirror)" || echo "the mirror of its packages does not answer"
}

permitted() {
    rm -rf "$home/check" && mkdir -p "$home/check"
    # shellcheck disable=SC2016
    isolated sh -ec 'cd "$1"; mount -t proc proc .; umount .; mknod null c 1 3; : <null' \
        sh "$home/check" 2>/dev/null
}

answers() {  # asked as debootstrap does
    [ -z "$1" ] || ! command -v wget >/dev/null ||
        wget -q --spider --timeout=20 --tries=3 "$1/dists/$release/InRelease"
}

make_system() {
    command -v debootstrap >/dev/null || {
        apt-get update || true
        apt-get install -y --no-install-recommends debootstrap debian-archive-keyring
    }
    rm -rf "$root"
    # shellcheck disable=SC2046
    debootstrap --variant=minbase --include=ca-certificates,make $release "$root" $(mirror)
    # less to write for a system that only runs tests
    printf '%s\n' force-unsafe-io 'path-exclude=/usr/share/'{doc,locale,man}'/*' \
        >"$root/etc/dpkg/dpkg.cfg.d/lean"
    echo 'APT::Keep-Downloaded-Packages "false";' >"$root/etc/apt/apt.conf.d/90lean"
}

# Give that Debian this machine's network, certificates, and settings of apt and pip.
copy_configuration() {
    local file
    cp -L /etc/resolv.conf /etc/hosts "$root/etc"
    for file in /usr/local/share/ca-certificates/*.crt; do
        [ ! -e "$file" ] || cp -L "$file" "$root/usr/local/share/ca-certificates"
    done
    cp -L "${SSL_CERT_FILE:-/etc/ssl/certs/ca-certificates.crt}" \
        "$root/etc/ssl/certs/ca-certificates.crt"
    # settings such as proxies and timeouts; sources.list is debootstrap's
    apt-config dump 2>/dev/null | grep '^Acquire::' >"$root/etc/apt/apt.conf.d/90machine" || true
    for file in /etc/pip.conf "$HOME/.pip/pip.conf" "$HOME/.config/pip/pip.conf"; do
        [ ! -e "$file" ] || install -D -m 644 "$file" "$root/${file/#"$HOME"/root}"
    done
}

# Replace the project in that Debian by this one, except for its environment.
copy_project() {
    mkdir -p "$root/project"
    find "$root/project" -mindepth 1 -maxdepth 1 ! -name '.venv*' -exec rm -rf {} +
    project_files | tar --create --null --files-from=- |
        tar --extract --no-same-owner --directory="$root/project"
}

project_files() {
    local file
    if git rev-parse --is-inside-work-tree >/dev/null 2>&1; then
        git ls-files -z --cached --others --exclude-standard | while IFS= read -r -d '' file; do
            [ ! -e "$file" ] || printf '%s\0' "$file"
        done
    else
        find . -mindepth 1 -name '.*' -prune -o -type f -print0
    fi
}

run_inside() {  # isolated
    local settings
    mount -t proc proc "$root/proc"
    mount -t sysfs -o ro sysfs "$root/sys"
    mount --rbind /dev "$root/dev"
    mapfile -t settings < <(env | grep -E '^(CI|TERM|MPI_TIMEOUT|[a-zA-Z]+_proxy|PIP_[A-Z_]+)=')
    # shellcheck disable=SC2016
    chroot "$root" env -i "${settings[@]}" HOME=/root LANG=C.UTF-8 \
        PATH=/usr/sbin:/usr/bin:/sbin:/bin PIP_CERT=/etc/ssl/certs/ca-certificates.crt \
        sh -c 'cd /project && exec "$@"' sh "$@"
}

case ${1:-} in
    "")
        sed -n '2,4s/^# //p' "$0" >&2
        exit 2
        ;;
    --check) obstacle ;;
    --make) make_system ;;
    --run) shift && run_inside "$@" ;;
    *)
        reason=$(obstacle)
        [ -z "$reason" ] || { echo "Debian $release cannot run on this machine: $reason" >&2; exit 1; }
        exec 9>"$home.lock" && flock 9
        if ! made; then
            echo "${home##*/}: making it with debootstrap"
            rm -f "$home/made"
            isolated "$0" --make >"$home/log" 2>&1 || { tail -n 40 "$home/log" >&2; exit 1; }
            echo "$key" >"$home/made"
        fi
        copy_configuration
        copy_project
        isolated "$0" --run "$@"
        ;;
esac
