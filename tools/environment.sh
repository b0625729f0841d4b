# Sourced by demo.sh, test.sh and check.sh: makes or reuses .venv/ at the root of the repository and installs KPC there.
# It runs in Bash 3.2, the version of macOS. PYTHON=... chooses the interpreter; pip's settings choose the package index.

cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1

fail() { echo "$(basename "$0"): $*" >&2; exit 1; }

new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

make_environment() {
    local python="" candidate
    for candidate in ${PYTHON:-python3.11 python3.12 python3.13 python3.14 python3}; do
        if new_enough "$candidate"; then python=$candidate; break; fi
    done
    [ -n "$python" ] || fail "needs Python 3.11 or newer: apt install python3-venv, or brew install python@3.12"
    "$python" -c 'import ensurepip, venv' 2>/dev/null || fail "this Python lacks venv: apt install python3-venv"
    echo "making .venv with $("$python" --version)" >&2
    rm -rf .venv
    "$python" -m venv .venv || fail ".venv: could not be made; is the disk full, or the folder read-only?"
}

# install_kpc EXTRAS: install kpc with these extras, unless they are installed already.
install_kpc() {
    local extras=$1 wanted stamp
    new_enough .venv/bin/python || make_environment
    wanted=$(cat pyproject.toml constraints.txt | cksum)
    for stamp in .venv/.installed-*; do  # "encoder,test" includes "encoder"
        case "$stamp" in *"-$extras"*) [ "$(cat "$stamp" 2>/dev/null)" != "$wanted" ] || return 0 ;; esac
    done
    echo "installing kpc[$extras] into .venv (the first time takes minutes: PyTorch is large)" >&2
    .venv/bin/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[$extras]" >&2 ||
        fail "pip could not install kpc[$extras]; its message above says why (no network? run this again once there is one)"
    printf '%s\n' "$wanted" > ".venv/.installed-$extras"
}

# Succeeds if OpenGL is available; otherwise prints in one line how to install it.
has_opengl() {
    .venv/bin/python - <<'PYTHON'
import sys
from kpc.format.common.errors import DisplayError
from kpc.player.gl.offscreen import open_context
try:
    open_context()
except DisplayError as error:
    sys.exit(f"{error}")
PYTHON
}
