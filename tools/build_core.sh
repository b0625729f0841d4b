#!/usr/bin/env bash
# Build the decoder core, format/core/*.wasm, from its C sources. Any clang with WebAssembly and lld will do; the
# modules that are committed come from Debian's clang-14 and lld-14 (14.0.6), and a test builds them again to compare.
#
#   bash tools/build_core.sh [FOLDER]      FOLDER is where the modules go; format/core without it
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../format/core"
folder="${1:-.}"

build() {
    "${CLANG:-clang}" --target=wasm32 -std=c11 -O3 -ffp-contract=off -fno-math-errno -fvisibility=hidden \
        -ffreestanding -mbulk-memory -Wall -Wextra -Werror -nostdlib "${@:2}" \
        -Wl,--no-entry -Wl,--strip-all -Wl,--stack-first -Wl,-z,stack-size=65536 -o "$folder/$1" -- *.c
    chmod -x "$folder/$1"  # the linker makes it executable, which it is not
}

build kpc_core.wasm -msimd128
build kpc_core_scalar.wasm
