#!/usr/bin/env bash
# Makes or reuses .venv/, installs KPC with what encoding and testing need, runs the whole suite. Arguments go to pytest.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"

install encoder,test
has_opengl || echo "tests that need OpenGL are skipped" >&2
exec .venv/bin/python -m pytest -ra "$@"
