#!/usr/bin/env bash
# From a fresh checkout to a scene on the screen: installs KPC, generates a clip, encodes it, renders views, and plays it.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"

install_kpc encoder
bin=.venv/bin
clip=out/default scene=out/default.kpc

if [ ! -f "$clip/gt/cameras.json" ]; then  # written last, so the clip is complete
    echo "generating the default scene, filmed by twelve cameras: $clip" >&2
    "$bin/python" -m kpc.tools.dev.scenegen "$clip"
fi

echo "encoding it: $scene (about two minutes on two cores)" >&2
"$bin/kpenc" "$clip" -o "$scene" --preset fast

echo "rendering novel views" >&2
if has_opengl; then
    backend=gl frames=96 size=384x288
else
    echo "no OpenGL: rendering a short, small orbit with the slow reference renderer instead" >&2
    backend=reference frames=12 size=128x96
fi
"$bin/kprender" "$scene" --backend "$backend" --cameras "$clip/gt/cameras.json" --depth -o out/views
"$bin/python" -m kpc.tools.cli.contactsheet "$clip/gt" out/views -o out/contactsheet.png
"$bin/kprender" "$scene" --backend "$backend" --orbit "$frames" --size "$size" -o out/orbit.mp4

echo "see out/contactsheet.png and out/orbit.mp4; play the scene with: $bin/kpplay $scene"
if [ "$backend" = gl ] && { [ "$(uname)" = Darwin ] || [ -n "${DISPLAY:-}${WAYLAND_DISPLAY:-}" ]; }; then
    exec "$bin/kpplay" "$scene"
fi
