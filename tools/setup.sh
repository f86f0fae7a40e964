#!/usr/bin/env bash
# Set up .venv: system packages, the virtual environment and pinned Python packages.
# Usage: tools/setup.sh PYTHON [browser|docs]   (called by make; installs only what is missing)
# browser: also install chromium and its driver, for the tests of the report's HTML page
# docs: also install the packages that build the documentation site
# Missing system packages are listed before they are installed. On a terminal, the user is
# asked for permission; elsewhere they are installed as root, or by sudo if no password is
# needed.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$1
extra=${2:-}

die() { echo "setup: $*" >&2; exit 1; }
has_package() { dpkg-query -W -f='${Status}' "$1" 2>/dev/null | grep -q ' installed$'; }
has_python() { "$python" -c "$1" >/dev/null 2>&1; }
has_headers='import os, sysconfig; os.stat(sysconfig.get_path("include") + "/Python.h")'

has_chromium() { command -v chromium || command -v chromium-browser; }

missing_packages() {
    local package
    if [ "$extra" = browser ]; then
        has_chromium >/dev/null || echo chromium
        return
    fi
    for package in libsuitesparse-dev libopenblas0-pthread gcc g++; do
        has_package "$package" || echo "$package"
    done
    command -v "$python" >/dev/null || echo python3
    has_python 'import ensurepip, venv' || echo python3-venv
    has_python "$has_headers" || echo python3-dev
}

install_packages() {
    local install=(apt-get install -y --no-install-recommends "$@") as_root=() answer
    echo "setup: missing system packages: $*"
    [ "$(id -u)" -eq 0 ] || as_root=(sudo)
    if [ -t 0 ] && [ -t 2 ]; then
        read -r -p "setup: run ${as_root[*]} ${install[*]}? [y/N] " answer || answer=
        [[ $answer =~ ^[Yy] ]] || die "nothing was installed; run: sudo ${install[*]}"
    elif [ ${#as_root[@]} -gt 0 ]; then
        as_root=(sudo -n)
        sudo -n true 2>/dev/null ||
            die "no terminal to ask for a password; run: sudo ${install[*]}"
    fi
    echo "setup: installing $* by ${as_root[*]} apt-get"
    "${as_root[@]}" apt-get update -qq || echo "setup: apt-get update failed; continuing" >&2
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive "${install[@]}" -qq >/dev/null ||
        die "could not install system packages; run: sudo ${install[*]}"
}

if command -v dpkg-query >/dev/null; then
    mapfile -t missing < <(missing_packages)
    [ ${#missing[@]} -eq 0 ] || install_packages "${missing[@]}"
else
    echo "setup: dpkg not found; this system must provide SuiteSparse 5.x with headers," \
        "an optimised BLAS (OpenBLAS), a C and C++ compiler, Python headers;" \
        "for the tests of the page: chromium"
fi

has_python 'import sys; assert sys.version_info >= (3, 11)' ||
    die "need Python >= 3.11, got $("$python" --version 2>&1 || true);" \
        "name another one: make PYTHON=python3.12"
.venv/bin/python -m pip --version >/dev/null 2>&1 ||
    "$python" -m venv --clear .venv ||
    die "could not create .venv with $python"

# These variables also pin the packages with which wheels are built; recent versions of pip
# read the second one. Each is a list separated by spaces, so the path is passed as a URI,
# which contains no spaces.
echo "setup: installing Python packages into .venv"
constraints=$(.venv/bin/python -c 'import pathlib; print(pathlib.Path("constraints.txt").resolve().as_uri())')
export PIP_CONSTRAINT=$constraints PIP_BUILD_CONSTRAINT=$constraints
.venv/bin/python -m pip install -q --disable-pip-version-check -e ".[${extra:-fleet,mpi,dev}]"
# Compile the bytecode once, as pip does for packages that it copies, instead of at first use.
.venv/bin/python -m compileall -q harness problems solvers reports mortarbench
