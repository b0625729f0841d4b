#!/usr/bin/env bash
# Lint, formatting, types, and packages: builds the wheel and the sdist, installs the wheel into an empty environment,
# and renders the sample scene with it.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"

install_kpc encoder,test,dev
out=out/check
rm -rf "$out" build && mkdir -p "$out"

echo "ruff" >&2
.venv/bin/ruff check .
.venv/bin/ruff format --check .

echo "mypy" >&2
.venv/bin/pip install --quiet --disable-pip-version-check --no-deps --target "$out/types" .
MYPYPATH="$out/types" .venv/bin/mypy --python-executable .venv/bin/python -p kpc

echo "packages" >&2
.venv/bin/python -m build --outdir "$out/dist" . > "$out/build.log" 2>&1 || { cat "$out/build.log" >&2; exit 1; }
.venv/bin/python -m venv "$out/empty"
"$out/empty/bin/pip" install --quiet --disable-pip-version-check -c constraints.txt "$out"/dist/*.whl
(
    cd "$out"  # away from the checkout, so that only the installed package can be found
    empty/bin/kprender ../../samples/default.kpc --backend reference --time 0.5 --size 96x72 -o sample.png
    empty/bin/python - <<'PYTHON'
from PIL import Image
low, high = zip(*Image.open("sample.png").convert("RGB").getextrema())
assert max(high) - min(low) > 100, f"the sample scene renders blank: {low} to {high}"
PYTHON
)
echo "lint, types and packages are in order" >&2
