#!/usr/bin/env bash
# Makes or reuses .venv/, installs KPC with everything the tests need, and runs them in one process per core, at most
# four. Arguments go to pytest (`-n 0`: in one process).
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"

install_kpc encoder,test
# The package is compiled to bytecode once, not by each of the many processes that tests start.
unset PYTHONDONTWRITEBYTECODE
.venv/bin/python -m compileall -q src encoder format player tools
has_opengl || echo "tests that need OpenGL are skipped" >&2
exec .venv/bin/python -m pytest -ra -n auto --maxprocesses 4 --dist worksteal "$@"
