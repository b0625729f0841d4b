"""The decoder core: a WebAssembly module that decodes what the codecs store (format/core/*.c), run by wasmtime.

The module imports nothing and touches no memory but its own, which the caller bounds. Instances are kept for reuse,
one for each thread that decodes at the same time; the interpreter lock is free while they run. What would run longer
than SECONDS and SECONDS_PER_NUMBER allow is stopped.
"""

import ctypes
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.resources import files

import numpy as np
import wasmtime

from kpc.format.common.errors import BudgetError, FormatError

# Largest memory of an instance, in bytes; WebAssembly has addresses of 32 bits.
ADDRESSES = 0xFFFF0000
PAGE = 1 << 16
# Instances whose memory has grown beyond this many bytes are not kept.
KEPT_BYTES = 64 << 20

# Time that a call may take: this many seconds, and seconds for each number that it decodes. A slow machine needs about
# a twentieth. Wasmtime counts in epochs of TICK_S, which become longer until the process has run for BUSY_SHARE of
# that: a busy machine is no reason to refuse a file.
SECONDS, SECONDS_PER_NUMBER = 5.0, 1e-5
TICK_S, BUSY_SHARE = 0.5, 0.5

# The functions of the module, in the order of `Function` in call.c.
FUNCTIONS = (
    *("kpc_begin", "kpc_segment", "kpc_project", "kpc_implied_map", "kpc_dequantise"),
    *("kpc_motion", "kpc_occupancy", "kpc_weights", "kpc_poses"),
)

# What the values of `Status` in kpc_core.h mean, with the details that callers give.
NO_MEMORY = 1
MESSAGES = {
    2: "its sizes are beyond the limits of the format",
    3: "cut off within its words",
    4: "its first state is too small",
    5: "its words do not end where they should",
    6: "its map follows from an occupancy that is not known",
    7: "unknown map mode",
    8: "too short for its map",
    9: "the unused bits of its map are not 0",
    10: "holds {length:,} bytes, which is not what its map implies",
    11: "unknown number of sets of weights or flag",
    12: "cut off within its weights",
    13: "a symbol leaves its 8 bits",
    14: "unknown side of blocks or flag, or a step of 0",
    15: "blocks of {side}, more than twice its {shorter} rows or columns",
    16: "a symbol leaves its 16 bits",
    17: "a power of two is not one of float16's",
    18: "one is no number of float16",
    19: "claims {raw_length:,} bytes, not those of its sizes",
    20: "cut off within its head",
    21: "{count} cameras (1 to 4096 allowed)",
    22: "{lens_count} lenses of {count} cameras, or positions in multiples of 2^{exponent}, make no sense",
    23: "{length:,} bytes are not those of {count} cameras and {lens_count} lenses",
    24: "a rotation or a position is out of range",
}


class Core:
    """An instance of the module, for one thread at a time."""

    def __init__(self) -> None:
        engine, module = _loaded()
        self._store = wasmtime.Store(engine)
        self._exports = wasmtime.Instance(self._store, module, []).exports(self._store)
        memory = self._exports["memory"]
        assert isinstance(memory, wasmtime.Memory)
        self._memory = memory
        arguments, call = self._exports["kpc_arguments"], self._exports["kpc_call"]
        assert isinstance(arguments, wasmtime.Func) and isinstance(call, wasmtime.Func)
        self._store.set_epoch_deadline(int(SECONDS / TICK_S) + 2)
        self._arguments, self._function = int(arguments(self._store)), call

    @property
    def size(self) -> int:
        """Bytes of memory that the instance has taken."""
        return self._memory.data_len(self._store)

    def begin(self, memory_limit: int, numbers: int, length: int) -> int:
        """Empty the memory, and return the address of `length` bytes for the arguments and results of one call.

        Args:
            memory_limit: bytes of memory that the instance may take.
            numbers: how many the call decodes, which decides how long it may take.

        Raises:
            BudgetError: the limit does not allow for them.
        """
        limit = max(min(memory_limit, ADDRESSES), self.size)
        self._store.set_limits(memory_size=-(-limit // PAGE) * PAGE)
        self._store.set_epoch_deadline(int((SECONDS + SECONDS_PER_NUMBER * numbers) / TICK_S) + 1)
        address = self._call("kpc_begin", limit, length) if length < ADDRESSES else 0
        if address == 0:
            raise BudgetError("decoding takes more memory than the budget allows")
        return address

    def put(self, address: int, content: bytes) -> None:
        """Copy bytes into the module."""
        ctypes.memmove(self._pointer(address, len(content)), content, len(content))

    def get(self, address: int, length: int) -> np.ndarray:
        """Return a copy of bytes of the module: (length,) uint8."""
        found = np.empty(length, np.uint8)
        ctypes.memmove(found.ctypes.data, self._pointer(address, length), length)
        return found

    def run(self, function: str, *arguments: int, what: str, **details: int) -> None:
        """Call a function that returns a status.

        Args:
            what: is decoded, for messages, such as "plane segment".
            details: numbers that messages name.

        Raises:
            FormatError: the status is not OK, or the function has run into the deadline.
            BudgetError: there is not enough memory.
        """
        try:
            status = self._call(function, *arguments)
        except wasmtime.Trap as trap:
            if trap.trap_code != wasmtime.TrapCode.INTERRUPT:
                raise
            raise FormatError(f"{what}: decoding takes far longer than its size allows") from trap
        if status == NO_MEMORY:
            raise BudgetError(f"{what}: decoding takes more memory than the budget allows")
        if status:
            raise FormatError(f"{what}: {MESSAGES[status].format(**details)}")

    def _call(self, name: str, *arguments: int) -> int:
        """Call a function through memory: wasmtime takes 15 microseconds for each argument."""
        self.put(self._arguments, struct.pack(f"<{1 + len(arguments)}I", FUNCTIONS.index(name), *arguments))
        self._function(self._store)
        return ctypes.c_uint32.from_address(self._pointer(self._arguments, 4)).value

    def _pointer(self, address: int, length: int) -> int:
        assert 0 <= address <= address + length <= self.size
        return ctypes.addressof(self._memory.data_ptr(self._store).contents) + address


_loading = threading.Lock()


def _loaded() -> tuple[wasmtime.Engine, wasmtime.Module]:
    """Return the engine of all instances, and the compiled module."""
    with _loading:  # several threads may be the first
        engine = _engine()
        return engine, _compiled(engine)


@cache
def _engine() -> wasmtime.Engine:
    """Return an engine whose epoch a thread counts up. It caches compiled modules on disk where it may write there."""
    config = wasmtime.Config()
    config.epoch_interruption = True
    with suppress(wasmtime.WasmtimeError):  # no home folder, or a read-only one: each process compiles for itself
        config.cache = True
    engine = wasmtime.Engine(config)

    thread = threading.Thread(target=count_epochs, args=(engine.increment_epoch,), daemon=True)
    thread.name = "deadline of the decoder core"
    thread.start()
    return engine


def count_epochs(
    increment: Callable[[], object],
    sleep: Callable[[float], None] = time.sleep,
    process_time: Callable[[], float] = time.process_time,
) -> None:
    """Count epochs without end.

    Args:
        increment: begins the next epoch.
        sleep: waits for so many seconds.
        process_time: returns for how many seconds the process has run.
    """
    begun_s = process_time()
    while True:
        sleep(TICK_S)
        now_s = process_time()
        if now_s - begun_s > BUSY_SHARE * TICK_S:
            begun_s = now_s
            increment()


@cache
def _compiled(engine: wasmtime.Engine) -> wasmtime.Module:
    """Return the module with vector instructions, or the other where this processor has none."""
    folder = files(__package__)
    try:
        return wasmtime.Module(engine, (folder / "kpc_core.wasm").read_bytes())
    except wasmtime.WasmtimeError:
        return wasmtime.Module(engine, (folder / "kpc_core_scalar.wasm").read_bytes())


_idle: list[Core] = []


@contextmanager
def borrow_core() -> Iterator[Core]:
    """Lend an instance. One in which something goes wrong is given up."""
    try:
        core = _idle.pop()
    except IndexError:
        core = Core()
    yield core
    if core.size <= KEPT_BYTES:
        _idle.append(core)
