#!/usr/bin/env bash
# Make .venv with the tested versions and this checkout in it, from whatever the machine has.
#
#   scripts/venv.sh [EXTRAS]    the extras of pyproject.toml to install; dev, which has them all, if left out
#
# A stamp a set of extras, holding the hash of what decides the installation, makes a second call free.
set -euo pipefail
cd "$(dirname "$0")/.."

extras=${1:-dev}
if [[ $extras == -* ]]; then
    sed -n '2,/^set /{s/^# \{0,1\}//p}' scripts/venv.sh
    [[ $extras == -h || $extras == --help ]] && exit 0
    exit 2
fi
venv=.venv
hash=$(cat pyproject.toml constraints.txt scripts/venv.sh scripts/uv_install.py | sha256sum | cut -d' ' -f1)
stamp=$venv/.installed-$extras
for file in "$stamp" "$venv/.installed-dev"; do
    [ -f "$file" ] && [ "$(cat "$file")" = "$hash" ] && exit 0
done

say() { printf '%s\n' "$*" >&2; }

find_python() {
    for candidate in ${PYTHON:-} python3 python3.14 python3.13 python3.12 python3.11; do
        if command -v "$candidate" >/dev/null 2>&1 &&
            "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' 2>/dev/null; then
            command -v "$candidate"
            return
        fi
    done
    say "attnwarp: needs Python 3.11 to 3.14 and found none; install one, or name it: make PYTHON=/path/to/python3.11"
    exit 2
}

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null 2>&1; then sudo -n "$@"; else return 1; fi
}

make_venv() {
    # Debian ships Python without ensurepip unless python3-venv is installed, so there are several ways in.
    rm -rf "$venv"
    if "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        "$python" -m venv "$venv" && return
    fi
    if command -v uv >/dev/null 2>&1; then
        uv venv --seed --python "$python" "$venv" && return
    fi
    if "$python" -m virtualenv --version >/dev/null 2>&1; then
        "$python" -m virtualenv --python "$python" "$venv" && return
    fi
    if "$python" -m pip --version >/dev/null 2>&1; then
        # A bare environment, and the machine's own pip to put a pip into it.
        rm -rf "$venv"
        "$python" -m venv --without-pip "$venv" && "$python" -m pip --python "$venv/bin/python" install --quiet pip && return
    fi
    if command -v apt-get >/dev/null 2>&1; then
        say "attnwarp: this Python cannot make virtual environments; installing Debian's python3-venv"
        if as_root apt-get update -qq && as_root apt-get install -y -qq python3-venv >&2; then
            rm -rf "$venv"
            "$python" -m venv "$venv" && return
        fi
    fi
    say "attnwarp: cannot make a virtual environment with $python; install python3-venv (Debian: sudo apt-get install python3-venv) or uv"
    exit 2
}

# Shared libraries that Open3D and Mitsuba link to without carrying them, by the Debian package that has each. Nothing is
# drawn with the graphics ones here; the libraries only have to load.
declare -A libraries=(
    [libEGL.so.1]=libegl1 [libGL.so.1]=libgl1 [libX11.so.6]=libx11-6 [libatomic.so.1]=libatomic1 [libgomp.so.1]=libgomp1
)

install_libraries() {
    local missing=()
    for library in "${!libraries[@]}"; do
        "$python" -c "import ctypes; ctypes.CDLL('$library')" 2>/dev/null || missing+=("${libraries[$library]}")
    done
    [ ${#missing[@]} = 0 ] && return
    if command -v apt-get >/dev/null 2>&1; then
        say "attnwarp: installing the shared libraries that Open3D and Mitsuba need: ${missing[*]}"
        if as_root apt-get update -qq && as_root apt-get install -y -qq --no-install-recommends "${missing[@]}" >&2; then
            return
        fi
    fi
    say "attnwarp: Open3D and Mitsuba need shared libraries that this machine lacks; install them, then run this again"
    say "  Debian, Ubuntu: sudo apt-get install ${missing[*]}"
    exit 2
}

python=$(find_python)
install_libraries
[ -x "$venv/bin/python" ] && "$venv/bin/python" -m pip --version >/dev/null 2>&1 || make_venv
say "attnwarp: installing the tested versions into $venv, with the extras $extras (a few minutes the first time)"
# Python compiles a module when it is first imported; pip would compile all 20,000, of which most are never used.
with_pip() { PYTHONWARNINGS=ignore "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile "$@"; }
# uv takes a third of pip's time. Where it cannot be had, or fails, pip does it and says what is wrong in its own words.
install() {
    "$venv/bin/python" scripts/uv_install.py --quiet -c constraints.txt "$@" 2>"$venv/uv.log" || with_pip -c constraints.txt "$@"
}
with_pip --only-binary uv uv==0.13.9 2>/dev/null || say "attnwarp: could not fetch uv, which is faster; going on with pip"
# torch first and by its exact version: a range could bring the newest build with several GB of CUDA.
install torch==2.13.0
install -e ".[$extras]"
printf '%s' "$hash" >"$stamp"
