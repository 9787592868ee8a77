#!/usr/bin/env bash
# Makes .venv with the pinned dependencies; run.sh and test.sh call it first.
#
# Does nothing when .venv is complete and fits pyproject.toml and the lock file. Missing
# system packages are installed where that needs no password; otherwise the one command
# to type is printed. Exit status: 0 ready, 4 not ready (one line says why).
#
# MAKEBREAK_PYTHON names another Python than python3. MAKEBREAK_DRAKE=1.58 installs the
# newer Drake, from its own lock file; .venv keeps it until MAKEBREAK_DRAKE=1.51 is set.
# With --compile, what the first run would compile, for a minute or two, is compiled as
# well.
set -euo pipefail

case "${1:-}" in
    "" | --compile) ;;
    *)
        echo "makebreak: setup.sh: got $1, expected --compile or nothing" >&2
        exit 2
        ;;
esac
compile="${1:-}"

root="$(dirname "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")")"
venv="$root/.venv"
unfinished="$venv/.unfinished" # There while .venv is being made.
ready="$venv/.ready"           # Written last: what .venv was made from.
unset PYTHONPATH PYTHONHOME    # Packages of other environments must not leak in.

say() { printf 'makebreak: %s\n' "$*" >&2; }
fail() {
    say "$@"
    exit 4
}

# Which Drake: the one asked for, else the one that .venv has, else the pinned one.
drake="${MAKEBREAK_DRAKE:-$(cat "$venv/.drake" 2>/dev/null || echo 1.51)}"
case "$drake" in
    1.51) lock="$root/requirements.lock" versions="3.10 to 3.14" ;;
    1.58) lock="$root/requirements-drake-1.58.lock" versions="3.12 to 3.14" ;;
    *) fail "MAKEBREAK_DRAKE is $drake, expected 1.51 or 1.58" ;;
esac

fingerprint() {
    cat "$root/pyproject.toml" "$lock" | sha256sum
    readlink -f "$venv/bin/python" # A new Python of the system: make .venv anew.
    printf '%s\n' "$root"          # Scripts in .venv/bin contain this path.
}

is_ready() {
    [[ -x "$venv/bin/python" && -r "$ready" && ! -e "$unfinished" ]] &&
        [[ "$(fingerprint)" == "$(<"$ready")" ]]
}

# Prints the missing needs, a line each: venv, and the sonames of libraries.
missing_needs() {
    "$python" - <<'PYTHON'
import glob

try:
    import ensurepip
    import venv
except ImportError:
    print("venv")
for soname in ["libX11.so.6", "libSM.so.6", "libglib-2.0.so.0", "libEGL.so.1"]:
    try:
        import ctypes

        ctypes.CDLL(soname)
    except (ImportError, OSError):
        print(soname)
drivers = ["dri/swrast_dri.so", "libgallium*.so"]
folders = ["/usr/lib", "/usr/lib/*", "/usr/lib64"]
if not any(glob.glob(f"{f}/{d}") for f in folders for d in drivers):
    print("swrast_dri.so")
PYTHON
}

# The package of a need; Debian 13 and Ubuntu 24.04 renamed GLib's.
package_of() {
    local versioned
    case "$1" in
        venv)
            versioned="python$version-venv"
            if apt-cache show "$versioned" &>/dev/null; then
                echo "$versioned"
            else
                echo python3-venv
            fi
            ;;
        libX11.so.6) echo libx11-6 ;;
        libSM.so.6) echo libsm6 ;;
        libglib-2.0.so.0)
            if apt-cache show libglib2.0-0t64 &>/dev/null; then
                echo libglib2.0-0t64
            else
                echo libglib2.0-0
            fi
            ;;
        libEGL.so.1) echo libegl1 ;;
        swrast_dri.so) echo libgl1-mesa-dri ;;
    esac
}

# Fills required, optional (packages) from the needs that are missing now.
look_for_packages() {
    local need
    required=() optional=()
    while read -r need; do
        case "$need" in
            libEGL.so.1 | swrast_dri.so) optional+=("$(package_of "$need")") ;;
            *) required+=("$(package_of "$need")") ;;
        esac
    done < <(missing_needs)
}

# The one command for a person to type.
apt_command() {
    local install="apt-get install -y --no-install-recommends $*"
    if [[ $EUID -eq 0 ]]; then
        echo "apt-get update && $install"
    elif command -v sudo >/dev/null; then
        echo "sudo apt-get update && sudo $install"
    else
        echo "su -c 'apt-get update && $install'"
    fi
}

apt_get() {
    local as_root=()
    [[ $EUID -eq 0 ]] || as_root=(sudo -n)
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -qq "$@" >>"$log" 2>&1
}

may_install() {
    command -v apt-get >/dev/null || return 1
    [[ $EUID -eq 0 ]] || { command -v sudo >/dev/null && sudo -n true 2>/dev/null; }
}

install_packages() {
    look_for_packages
    [[ $((${#required[@]} + ${#optional[@]})) -gt 0 ]] || return 0
    if may_install; then
        say "installing system packages: ${required[*]} ${optional[*]}"
        apt_get update || true # An old list may do; if not, the install below says so.
        look_for_packages  # The names depend on the list.
        apt_get install -y --no-install-recommends "${required[@]}" "${optional[@]}" ||
            { [[ ${#required[@]} -eq 0 ]] ||
                apt_get install -y --no-install-recommends "${required[@]}"; } || true
        look_for_packages
    fi
    if [[ ${#required[@]} -gt 0 ]]; then
        if ! command -v apt-get >/dev/null; then
            fail "please install what Debian calls: ${required[*]} ${optional[*]}"
        elif may_install; then
            fail "apt-get could not install ${required[*]} (no network?) (log: $log)"
        fi
        fail "type this once, then try again:" \
            "$(apt_command "${required[@]}" "${optional[@]}")"
    fi
    if [[ ${#optional[@]} -gt 0 ]]; then
        say "no OpenGL, so OpenCV draws the camera's pictures (for VTK's:" \
            "$(apt_command "${optional[@]}"))"
    fi
}

pip_install() {
    "$venv/bin/python" -m pip install --quiet --no-input --progress-bar off \
        --disable-pip-version-check "$@" >>"$log" 2>&1 && return
    if grep -q 'CERTIFICATE_VERIFY_FAILED' "$log"; then
        fail "the package index's certificate is not trusted (a proxy with its own?);" \
            "set PIP_CERT to the file with its certificate, then try again (log: $log)"
    fi
    if grep -qE 'Retrying|[Tt]imed out|Timeout|ConnectionError|IncompleteRead' "$log"; then
        fail "the Python package index cannot be reached; check the network," \
            "then try again (log: $log)"
    fi
    fail "pip failed: $(grep '^ERROR' "$log" | tail -n 1) (log: $log)"
}

compile_if_asked() {
    [[ -n "$compile" ]] || return 0
    say "compiling (once; a minute or two)"
    OMP_NUM_THREADS=1 "$venv/bin/makebreak" compile ||
        fail "could not compile; the first run will"
}

is_ready && compile_if_asked && exit 0

python="${MAKEBREAK_PYTHON:-python3}"
command -v "$python" >/dev/null ||
    fail "no $python; type this once, then try again: $(apt_command python3-venv)"
version="$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')"
case "$drake $version" in
    "1.51 3.10" | "1.51 3.11" | 1.5[18]\ 3.1[234]) ;;
    *) fail "$python is Python $version, expected $versions (for Drake $drake);" \
        "set MAKEBREAK_PYTHON to one of these" ;;
esac
case "$drake $(uname -sm)" in
    *" Linux x86_64" | *" Darwin arm64" | "1.58 Linux aarch64") ;;
    *) fail "this is $(uname -sm), expected Linux x86_64: Drake $drake has no wheel" ;;
esac

# Two scripts started at once: the second waits here, and then has nothing to do.
if command -v flock >/dev/null; then
    { exec 9>"$root/.venv.lock"; } 2>/dev/null || fail "cannot write in $root"
    flock -n 9 || { say "waiting for another set-up to end" && flock 9; }
    is_ready && compile_if_asked && exit 0
fi

log="$(mktemp "${TMPDIR:-/tmp}/makebreak-setup.XXXXXX")"
trap '[[ -s "$log" ]] || rm -f "$log"' EXIT # Kept only where it tells something.
install_packages

# What an interrupted set-up or a move of the folder left is not to be trusted.
if [[ -e "$unfinished" || ! -x "$venv/bin/python" ]] ||
    { [[ -e "$ready" ]] && [[ "$(fingerprint | tail -n 2)" != "$(tail -n 2 "$ready")" ]]; }; then
    rm -rf "$venv"
fi
say "setting up .venv (once; this takes a few minutes)"
mkdir -p "$venv" 2>/dev/null || fail "cannot write in $root"
touch "$unfinished"
rm -f "$ready"
[[ -x "$venv/bin/python" ]] || "$python" -m venv "$venv" >>"$log" 2>&1 ||
    fail "$python -m venv failed (log: $log)"
pip_install -r "$lock"
pip_install --no-deps --no-build-isolation -e "$root"
"$venv/bin/python" -c 'import pydrake.multibody.plant' >>"$log" 2>&1 ||
    fail "Drake does not load: $(tail -n 1 "$log")"
printf '%s\n' "$drake" >"$venv/.drake"
fingerprint >"$ready"
rm -f "$unfinished" "$log"
say "ready"
compile_if_asked
