"""The decoder core: how it is built, that its tables are the package's, and that it stays within memory and time."""

import re
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import wasmtime

from codec_inputs import random_blocks, textured
from kpc.encoder.coding import predictive, rans, texel_map, transform, weights
from kpc.format.coding.quantise import dequantise_symbols
from kpc.format.common.errors import BudgetError, FormatError
from kpc.format.container import scene_layout
from kpc.format.container.container import Codec
from kpc.format.core import core, decoding

ROOT = Path(__file__).parent.parent.parent
FOLDER = ROOT / "format" / "core"
MODULES = ("kpc_core.wasm", "kpc_core_scalar.wasm")
HEADER = (FOLDER / "kpc_core.h").read_text()
SOURCES = "".join(path.read_text() for path in sorted(FOLDER.glob("*.[ch]")))

# The compiler and linker that the committed modules come from; others may make other bytes.
CLANG = "Debian clang version 14.0.6"


@pytest.mark.parametrize("name", MODULES)
def test_modules_are_small_and_import_nothing(name):
    content = (FOLDER / name).read_bytes()
    assert len(content) <= 64 * 1024
    assert wasmtime.Module(wasmtime.Engine(), content).imports == []


def test_modules_are_those_of_their_sources(tmp_path):
    clang = shutil.which("clang")
    version = subprocess.run([clang, "--version"], capture_output=True, text=True).stdout if clang else "no clang"
    if not version.startswith(CLANG) or shutil.which("wasm-ld") is None:
        pytest.skip(f"needs {CLANG} with lld, not {version.splitlines()[0]}")
    subprocess.run(["bash", ROOT / "tools" / "build_core.sh", tmp_path], check=True)
    for name in MODULES:
        assert (tmp_path / name).read_bytes() == (FOLDER / name).read_bytes(), f"run tools/build_core.sh ({name})"


def table(name: str) -> list[int]:
    """The numbers of a table of the header, in their order."""
    (rows,) = re.findall(rf"\b{name}(?:\[\d+\])+ = (\{{.*?\}});", HEADER, re.DOTALL)
    return [int(number) for number in re.findall(r"-?\d+", rows)]


def test_functions_are_called_by_their_numbers():
    (names,) = re.findall(r"typedef enum \{ ([A-Z_0-9=, ]+) \} Function;", (FOLDER / "call.c").read_text())
    numbered = [re.sub(r" = 0", "", name).lower() for name in names.split(", ")]
    assert [f"kpc_{name}" for name in numbered] == list(core.FUNCTIONS)


def test_tables_are_those_of_the_package():
    assert table("OFFSET_SCALE") == transform.OFFSET_SCALES.tolist()
    assert table("COSINE") == transform.COSINES.tolist()
    assert table("FREQUENCY_SCALE") == [int(n) for side in transform.SIDES for n in transform.frequency_weights(side)]
    assert table("LEVEL_PROBABILITY") == transform.INITIAL_PROBABILITIES.ravel().tolist()
    assert table("MEAN_PROBABILITY") == transform.INITIAL_MEAN_PROBABILITIES.tolist()
    assert table("SIGN_PROBABILITY") == transform.SIGN_PROBABILITIES.tolist()


def test_limits_are_those_of_the_package():
    limits = {name: int(value) for name, value in re.findall(r"#define (\w+_LIMIT) (\d+)", HEADER)}
    assert limits.pop("ADAPTATION_LIMIT") == rans.ADAPTATION_LIMIT
    assert limits == {name: getattr(scene_layout, name) for name in limits} and len(limits) == 6
    defined = {name: int(value) for name, value in re.findall(r"#define (\w+) \(?(-?\d+)\)?(?: |$)", SOURCES, re.M)}
    assert defined["LOWEST_STATE"] == rans.LOWEST_STATE
    assert defined["EVEN_PROBABILITY"] == rans.EVEN_PROBABILITY
    assert defined["MAP_CONTEXTS"] == texel_map.MAP_CONTEXTS
    assert defined["INITIAL_COUNT"] == transform.INITIAL_USES
    assert defined["INITIAL_DEVIATION"] == predictive.INITIAL_RESIDUAL
    assert defined["LARGEST_INTEGER"] == weights.LARGEST
    assert (defined["LEVEL_UNARY"], defined["LEVEL_ESCAPE"]) == (transform.UNARY, transform.ESCAPES)
    assert (defined["END_UNARY"], defined["END_ESCAPE"]) == (transform.END_UNARY, transform.END_ESCAPES)


def test_every_status_has_a_message():
    values = {int(value) for value in re.findall(r"^    [A-Z_0-9]+ = (\d+),", HEADER, re.M)}
    assert values == {0, core.NO_MEMORY, *core.MESSAGES}


def predictive_body() -> tuple[bytes, np.ndarray, np.ndarray]:
    symbols, coded = textured()
    return predictive.encode_symbols(symbols, coded), symbols, coded


def test_threads_decode_at_the_same_time():
    body, symbols, coded = predictive_body()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: decoding.decode_segment(Codec.PREDICTIVE, body, *symbols.shape), range(16)))
    for one, where in found:
        np.testing.assert_array_equal(one, symbols)
        np.testing.assert_array_equal(where, coded)


def test_both_modules_decode_the_same(monkeypatch):
    blocks, coded = random_blocks(8, 40, 50, 0.7, 1)
    body = transform.encode_blocks(blocks, coded)
    usual = decoding.decode_segment(Codec.TRANSFORM, body, 40, 50, 3)
    scalar = wasmtime.Module(core._engine(), (FOLDER / MODULES[1]).read_bytes())
    monkeypatch.setattr(core, "_idle", [])
    monkeypatch.setattr(core, "_compiled", lambda _: scalar)
    for one, other in zip(usual, decoding.decode_segment(Codec.TRANSFORM, body, 40, 50, 3), strict=True):
        np.testing.assert_array_equal(one, other)


def test_no_home_folder_is_needed(monkeypatch, tmp_path):
    (tmp_path / "file").write_bytes(b"")  # below which no folder can be made
    for name in "HOME", "XDG_CACHE_HOME", "USERPROFILE":
        monkeypatch.setenv(name, str(tmp_path / "file" / "home"))
    assert core._compiled.__wrapped__(core._engine.__wrapped__()).exports


def test_memory_is_that_of_the_budget(monkeypatch):
    monkeypatch.setattr(decoding, "CORE_BYTES", 2 << 20)
    monkeypatch.setattr(core, "_idle", [])
    body, symbols, _ = predictive_body()
    decoding.decode_segment(Codec.PREDICTIVE, body, *symbols.shape, memory_limit=1 << 20)
    assert core._idle[0].size <= 3 << 20
    with pytest.raises(BudgetError, match="more memory than the budget allows"):
        decoding.decode_segment(Codec.PREDICTIVE, body, 4096, 4096, 1, memory_limit=1 << 20)
    claims = (16384).to_bytes(2, "little") * 2 + (256).to_bytes(2, "little") * 2
    with pytest.raises(BudgetError, match="more memory than the budget allows"):
        decoding.decode_occupancy(claims + bytes(8), 8 + (1 << 41), memory_limit=1 << 20)


def test_what_does_not_end_is_stopped(monkeypatch):
    endless = """(module (memory (export "memory") 1)
        (func (export "kpc_arguments") (result i32) i32.const 16)
        (func (export "kpc_call") (if (i32.load (i32.const 16)) (then (loop br 0)))
            (i32.store (i32.const 16) (i32.const 256))))"""  # kpc_begin, whose number is 0, returns an address
    module = wasmtime.Module(core._engine(), endless)
    monkeypatch.setattr(core, "_idle", [])
    monkeypatch.setattr(core, "_compiled", lambda _: module)
    monkeypatch.setattr(core, "SECONDS", 0.0)
    monkeypatch.setattr(core, "TICK_S", 0.05)
    with pytest.raises(FormatError, match="takes far longer than its size allows"):
        decoding.decode_motion(bytes(16), 100)
    assert core._idle == []


def test_epochs_are_longer_on_a_busy_machine():
    """The process runs for a fifth of each tick, so that an epoch takes three."""
    epochs, slept = [], []

    def sleep(seconds):
        slept.append(seconds)
        if len(slept) > 30:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        core.count_epochs(lambda: epochs.append(len(slept)), sleep, lambda: core.TICK_S * len(slept) / 5)
    assert epochs == list(range(3, 31, 3))


@pytest.mark.parametrize("codec", [Codec.RAW, Codec.PREDICTIVE, Codec.TRANSFORM])
def test_bytes_of_any_kind_are_decoded_or_refused(codec):
    rng = np.random.default_rng(int(codec))
    head = {Codec.RAW: [1], Codec.PREDICTIVE: [1, 1, *range(9)], Codec.TRANSFORM: [4, 1, 9]}[codec]
    for length in range(300):
        body = bytes(head) + rng.integers(0, 256, length, np.uint8).tobytes()
        try:
            symbols, coded = decoding.decode_segment(codec, body, 9, 11, 2)
        except FormatError:
            continue
        assert not symbols[~coded].any()


def test_values_are_those_of_the_package():
    """The core's dequantisation, which other hosts use, rounds as numpy does."""
    rng = np.random.default_rng(0)
    symbols = rng.integers(-128, 128, (500, 7)).astype(np.int8)
    step, offset = (rng.normal(0, 1, 7).astype(np.float32) for _ in range(2))
    with core.borrow_core() as one:
        values = one.begin(1 << 24, 3500, 5 * symbols.size + 56)
        steps, offsets, at = (values + 4 * symbols.size + k for k in (0, 28, 56))
        for address, content in ((steps, step), (offsets, offset), (at, symbols)):
            one.put(address, content.tobytes())
        one.run("kpc_dequantise", at, 500, 7, steps, offsets, values, what="plane")
        found = one.get(values, 4 * symbols.size).view(np.float32).reshape(symbols.shape)
    np.testing.assert_array_equal(found, dequantise_symbols(symbols, step, offset))
