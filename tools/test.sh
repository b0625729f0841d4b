#!/usr/bin/env bash
# Makes or reuses .venv/, installs KPC with all it needs, runs the whole test suite. Arguments go to pytest.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"

install_kpc encoder,test
has_opengl || echo "tests that need OpenGL are skipped" >&2
exec .venv/bin/python -m pytest -ra "$@"
