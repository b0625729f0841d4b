"""Fuzz the reader with damaged files: `python -m kpc.tools.vectors.fuzz --count 1000000 --processes 2 --seed 1 -o
found`.

Conformance vectors are taken apart, mutated, and put together again with every length and CRC32C right, so that
mutations reach the code behind those checks. A reader must read the result or refuse it with a FormatError. Anything
else that is raised, more than HANG_S of computing and more memory than the budget are findings, which are written to
-o as files. File number N of a seed is always the same, so that a run may be split: --first 500000 --count 500000 is
the second half of the one above. `--only transform,motion` mutates just the vectors whose names begin so. `--reader
web` lets the browser player read them, under node.

The mutations and the processes that try them are one module because neither is used elsewhere.
"""

import json
import multiprocessing
import os
import random
import struct
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, cast

import google_crc32c
import numpy as np
import zstandard

from kpc.format.common import cli
from kpc.format.common.errors import FormatError, KpcError, UsageError
from kpc.format.container.container import Codec, Entry, Reader, header_and_index
from kpc.format.container.groups import Groups
from kpc.format.container.partial import PartialScene
from kpc.format.container.scene_io import SceneReader, read
from kpc.format.container.scene_layout import GROUP_KIND
from kpc.format.scene.scene import ALL_PLANES
from kpc.tools.dev.fuzz_options import check_range, fuzz_parser
from kpc.tools.vectors import specvectors
from kpc.tools.vectors.files import ENTRY_FIELDS, HEADER_FIELDS, sealed, with_entry, with_index
from kpc.tools.vectors.web_reader import WebReader

BUDGET = 32 << 20  # memory budget of the reader in bytes, small enough that what exceeds it shows
WEB_BUDGET = 48 << 20  # that of the browser player, which counts textures and what its workers take, too
SLACK = 96 << 20  # bytes that Python, its threads and earlier files may take beside it
# Seconds of processor time that count as a hang, and after which a process is ended from outside.
HANG_S, KILL_S = 2.0, 30.0
STUCK_S = 600.0  # seconds of wall time after which a process is ended that does not compute
REPORT_EVERY = 200  # files

LARGEST = 1 << 20  # bytes of a chunk whose content is mutated before it is compressed again
# Vectors that take 0.23 and 0.1 s to read, where the others take 4 ms on average.
LONG = ("limits-cameras", "limits-appearances")

BITS = {1: "<B", 2: "<H", 4: "<I", 8: "<Q"}
WHOLES = (
    0,
    1,
    2,
    3,
    7,
    127,
    128,
    255,
    256,
    0x7FFF,
    0x8000,
    0xFFFF,
    0x10000,
    1 << 24,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    1 << 50,
)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-30, 1e30, 3e38, float("nan"), float("inf"), -float("inf"), 5e-324, 1e300)
KINDS = ("SCNE", "WARP", "MOVE", "DECO", "HYBR", "OCCU", "came", "appe", "meta", "soun", "PLNE", "GRUP", "note", "Note")


@dataclass(frozen=True)
class Piece:
    """A chunk: its index entry and its stored bytes."""

    entry: Entry
    body: bytes


@dataclass(frozen=True)
class Taken:
    """A file taken apart into its chunks."""

    value_count: int
    pieces: tuple[Piece, ...]

    @staticmethod
    def of(data: bytes) -> "Taken":
        reader = Reader(data, allow_partial=True)
        return Taken(
            reader.header.value_count,
            tuple(
                Piece(entry, reader.stored(number))
                for number, entry in enumerate(reader.index)
                if reader.available(number)
            ),
        )

    def together(self) -> bytes:
        """Return a file again, right in everything but what the chunks say."""
        entries = [
            replace(
                e,
                stored_length=len(body),
                crc=google_crc32c.value(body),
                raw_length=len(body) if e.codec == Codec.RAW else min(e.raw_length, 0xFFFFFFFF),
            )
            for e, body in ((piece.entry, piece.body) for piece in self.pieces)
        ]
        return header_and_index(entries, self.value_count, compress=False) + b"".join(
            piece.body for piece in self.pieces
        )


Mutation = Callable[[random.Random, Taken, Sequence[Taken]], bytes]


def scrambled(rng: random.Random, body: bytes) -> bytes:
    """Apply up to four edits: flipped bits, extreme numbers, bytes removed, inserted or repeated; most near the
    start, where sizes are.
    """
    out = bytearray(body)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(min(len(out), rng.choice((16, 64, len(out) or 1))) or 1)
        until = at + rng.choice((1, 2, 4, 9, 40))
        match rng.randrange(8):
            case 0 if out:
                out[at] ^= 1 << rng.randrange(8)
            case 1 if out:
                out[at] = rng.randrange(256)
            case 2 | 3:
                put = _number(rng, rng.choice((1, 2, 4, 8)))
                out[at : at + len(put)] = put
            case 4:
                del out[at:until]
            case 5:
                out[at:at] = rng.randbytes(until - at)
            case 6:
                out[at:at] = out[at:until]
            case _:
                out[at:until] = bytes([rng.choice((0, 255))]) * len(out[at:until])
    return bytes(out)


def _number(rng: random.Random, size: int) -> bytes:
    if size >= 4 and rng.random() < 0.4:
        with np.errstate(over="ignore"):
            return np.array(rng.choice(FLOATS), "<f4" if size == 4 else "<f8").tobytes()
    return struct.pack(BITS[size], rng.choice(WHOLES) & (1 << 8 * size) - 1)


def in_header(rng: random.Random, taken: Taken, others: Sequence[Taken]) -> bytes:
    """Mutate a field of the header; its checksum is right."""
    out = bytearray(taken.together())
    at, layout = rng.choice([(0, "<Q"), *HEADER_FIELDS.values()])
    size = struct.calcsize(layout)
    out[at : at + size] = _number(rng, size) if rng.random() < 0.7 else rng.randbytes(size)
    struct.pack_into("<I", out, HEADER_FIELDS["header_crc"][0], google_crc32c.value(bytes(out[:44])))
    return bytes(out)


def in_index(rng: random.Random, taken: Taken, others: Sequence[Taken]) -> bytes:
    """Mutate one or two fields of index entries; checksums of index and header are right."""
    data = taken.together()
    for _ in range(rng.choice((1, 1, 2))):
        field, number = rng.choice(list(ENTRY_FIELDS)), rng.randrange(len(taken.pieces))
        if field == "kind":
            data = with_entry(data, number, field, rng.choice(KINDS).encode())
            continue
        size = struct.calcsize(ENTRY_FIELDS[field][1])
        nearby = _field(taken, number, field) + rng.choice((-2, -1, 1, 2)) & (1 << 8 * size) - 1
        value = nearby if rng.random() < 0.5 else int.from_bytes(_number(rng, size), "little")
        data = with_entry(data, number, field, value)
    if rng.random() < 0.3:  # otherwise most files are refused because a chunk is too long
        data = data[:40] + struct.pack("<I", min(len(data) << 15, 0xFFFFFFFF)) + data[44:]
    return sealed(data)


def _field(taken: Taken, number: int, field: str) -> int:
    piece = taken.pieces[number]
    known = {"stored_length": len(piece.body), "crc": google_crc32c.value(piece.body)}
    return known[field] if field in known else int(getattr(piece.entry, field))


def in_frame(rng: random.Random, taken: Taken, others: Sequence[Taken]) -> bytes:
    """Mutate one or two bytes of the index, the zstd frame around it, or the number of chunks."""

    def edited(table: bytes) -> bytes:
        out = bytearray(table)
        for _ in range(rng.choice((1, 1, 2)) if out else 0):
            at = rng.randrange(len(out))
            out[at] = rng.choice((0, 1, 255, out[at] ^ 1, rng.randrange(256)))
        return bytes(out)

    data = taken.together()
    match rng.randrange(4):
        case 0:
            return with_index(data, frame=lambda frame: scrambled(rng, frame))
        case 1:
            return with_index(data, count=rng.choice(WHOLES) & 0xFFFFFFFF)
        case _:
            return with_index(data, edited)


def in_content(rng: random.Random, taken: Taken, others: Sequence[Taken]) -> bytes:
    """Mutate the content of a chunk under its codec; that of a group in any of these ways."""
    pieces = list(taken.pieces)
    number = rng.randrange(len(pieces))
    entry, body = pieces[number].entry, pieces[number].body
    if entry.kind == GROUP_KIND and rng.random() < 0.9 and (group := _taken(body)):
        body = mutated(rng, group, others)
    elif entry.codec == Codec.ZSTD and rng.random() < 0.9 and (raw := _decompressed(body)) is not None:
        raw = scrambled(rng, raw)
        entry, body = replace(entry, raw_length=len(raw)), zstandard.ZstdCompressor(level=1).compress(raw)
    else:
        body = scrambled(rng, body)
        if rng.random() < 0.1:
            entry = replace(entry, raw_length=rng.choice(WHOLES), codec=rng.randrange(len(Codec) + 1))
    pieces[number] = Piece(entry, body)
    return replace(taken, pieces=tuple(pieces)).together()


def of_chunks(rng: random.Random, taken: Taken, others: Sequence[Taken]) -> bytes:
    """Remove, repeat, swap or replace chunks, also by those of another file."""
    pieces = list(taken.pieces)
    at, to = rng.randrange(len(pieces)), rng.randrange(len(pieces))
    strange = rng.choice(rng.choice(others).pieces)
    match rng.randrange(5):
        case 0 if len(pieces) > 1:
            del pieces[at]
        case 1:
            pieces.insert(to, pieces[at])
        case 2:
            pieces[at], pieces[to] = pieces[to], pieces[at]
        case 3:
            pieces.insert(at, strange)
        case _:
            pieces[at] = strange
    value_count = taken.value_count if rng.random() < 0.7 else rng.choice((0, 1, 1 << 20, 1 << 24))
    return Taken(value_count, tuple(pieces)).together()


def of_bytes(rng: random.Random, taken: Taken, others: Sequence[Taken]) -> bytes:
    """Mutate any bytes, without correcting checksums; or truncate the file."""
    data = taken.together()
    return data[: rng.randrange(len(data))] if rng.random() < 0.5 else scrambled(rng, data)


MUTATIONS: dict[str, Mutation] = {
    "header": in_header,
    "index": in_index,
    "frame": in_frame,
    "content": in_content,
    "chunks": of_chunks,
    "bytes": of_bytes,
}
SHARES = (1, 3, 1, 12, 3, 1)  # relative frequencies of MUTATIONS


def mutated(rng: random.Random, taken: Taken, others: Sequence[Taken]) -> bytes:
    """Return a file mutated once, seldom twice."""
    data = rng.choices(list(MUTATIONS.values()), SHARES)[0](rng, taken, others)
    if rng.random() < 0.15 and (again := _taken(data)):
        return mutated(rng, again, others)
    return data


def _taken(data: bytes) -> Taken | None:
    """Take a file apart; None if that is no longer possible."""
    try:
        taken = Taken.of(data)
    except FormatError:
        return None
    return taken if taken.pieces else None


def _decompressed(body: bytes) -> bytes | None:
    """Return the content of a zstd frame; None if it is not one or claims more than LARGEST, which the library would
    believe.
    """
    try:
        said = zstandard.get_frame_parameters(body).content_size
        if LARGEST < said < zstandard.CONTENTSIZE_ERROR:
            return None
        return zstandard.ZstdDecompressor().decompress(body, max_output_size=LARGEST)
    except zstandard.ZstdError:
        return None


def seeds(only: str = "") -> list[Taken]:
    """Return the valid conformance vectors, taken apart, whose names begin with one of `only`, separated by commas;
    but for LONG.
    """
    begins = tuple(only.split(","))
    return [
        Taken.of(data)
        for path, data in specvectors.files().items()
        if path.startswith("valid/") and Path(path).stem.startswith(begins) and Path(path).stem not in LONG
    ]


def examined(data: bytes, budget: int = BUDGET) -> str:
    """Read a file at once, then in parts as it arrives; return "read" or the name of the error that refused it.

    Raises:
        Anything but a FormatError: a finding.
    """
    try:
        groups = Groups(data, memory_budget=budget)
        for number in range(len(groups)):
            read(groups.open(number), memory_budget=budget).dequantise()
        said = "read"
    except FormatError as error:
        said = type(error).__name__
    try:
        arriving = Groups(data, memory_budget=budget, allow_partial=True, in_parts=True)
        for number in filter(arriving.available, range(len(arriving))):
            _fetch(arriving.open(number), budget)
    except FormatError as error:
        return said if said != "read" else f"in parts: {type(error).__name__}"
    return said


def _fetch(reader: SceneReader, budget: int) -> None:
    """Fetch segments within the budget, as a player does, look at a row of each and drop every other one."""
    part, spent = PartialScene(reader), 0
    for number, size in zip(part.numbers, part.sizes, strict=True):
        spent += 5 * int(size)
        if spent > budget or not reader.available(number):
            break
        part.fetch([number])
        entry = part.entry(number)
        plane = part.scene.scales[entry.scale][ALL_PLANES[entry.plane]]
        if not np.isfinite(plane[entry.row_start]).all():
            raise AssertionError("a plane holds what is no number")
        if number % 2:
            part.drop(number)


# --- many of them


def file_number(seed: int, number: int, starts: Sequence[Taken]) -> bytes:
    rng = random.Random(f"{seed}/{number}")
    return mutated(rng, rng.choice(starts), starts)


def _work(
    pipe: Connection,
    now: Any,
    seed: int,
    numbers: range,
    skipped: frozenset[int],
    budget: int,
    only: str,
    web: bool = False,
) -> None:
    """Examine files and send (next number, outcomes, findings) every so often.

    Args:
        now: shared with the parent: the number of the current file, and its start in processor time and in wall time.
        web: whether the browser player reads them.
    """
    warnings.simplefilter("error")
    starts = seeds(only)
    reader = WebReader(budget) if web else None
    if reader is None:
        for taken in starts:
            examined(taken.together(), budget)  # compiles and imports what is needed
        _limit_memory(budget + SLACK)
    tally: Counter[str] = Counter()
    findings: list[tuple[int, str]] = []
    for k, number in enumerate(numbers):
        if number not in skipped:
            data = file_number(seed, number, starts)
            begun = time.process_time()
            now[:] = number, begun, time.monotonic()
            try:
                tally[examined(data, budget) if reader is None else reader.examined(data, HANG_S)] += 1
            except Exception as error:  # any exception but a FormatError is a finding
                tally["finding"] += 1
                findings.append((number, f"{type(error).__name__}: {error}"))
            if time.process_time() - begun > HANG_S:
                findings.append((number, f"took {time.process_time() - begun:.1f} s"))
        if k % REPORT_EVERY == REPORT_EVERY - 1 or number == numbers[-1]:
            pipe.send((number + numbers.step, tally, findings))
            tally, findings = Counter(), []
    if reader is not None:
        reader.close()


def _limit_memory(more_bytes: int) -> None:
    """Limit the memory of this process to so much more than it has, where the system can; then it fails with
    MemoryError.
    """
    try:
        import resource

        taken = 1024 * int(Path("/proc/self/status").read_text().split("VmData:")[1].split()[0])
        resource.setrlimit(resource.RLIMIT_DATA, (taken + more_bytes, resource.RLIM_INFINITY))
    except (ImportError, OSError, IndexError):
        pass


def _computed_s(pid: int) -> float:
    """Return the processor time of another process in seconds; 0 where the system does not report it."""
    try:
        user, system = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, AttributeError):
        return 0.0


def run(
    count: int,
    seed: int,
    processes: int,
    budget: int = BUDGET,
    say: Callable[[str], None] = lambda text: None,
    first: int = 0,
    only: str = "",
    web: bool = False,
) -> dict[str, Any]:
    """Examine `count` files from number `first` on, made of `seeds(only)`; return the outcomes, and findings as
    [number, message].
    """
    context, started, said = multiprocessing.get_context("spawn"), time.monotonic(), time.monotonic()
    tally: Counter[str] = Counter()
    findings: list[tuple[int, str]] = []
    jobs: dict[Any, tuple[Any, Any, range, frozenset[int]]] = {}

    def begin(numbers: range, skipped: frozenset[int]) -> None:
        ours, theirs = context.Pipe(duplex=False)
        now = context.Array("d", [-1.0, 300.0, time.monotonic()], lock=False)  # the first takes a while
        process = context.Process(
            target=_work, args=(theirs, now, seed, numbers, skipped, budget, only, web), daemon=True
        )
        process.start()
        theirs.close()
        jobs[ours] = process, now, numbers, skipped

    stop = first + count
    for start in range(first, min(first + processes, stop)):
        begin(range(start, stop, processes), frozenset())
    while jobs:
        for pipe in wait(list(jobs), timeout=1.0):
            process, now, numbers, skipped = jobs[pipe]
            try:
                following, outcomes, found = cast(Connection, pipe).recv()
                tally += outcomes
                findings += found
                for number, what in found:
                    say(f"file {number}: {what}")
                jobs[pipe] = process, now, range(following, stop, processes), skipped
            except EOFError:
                process.join()
                del jobs[pipe]
                if len(numbers):
                    findings.append((int(now[0]), f"the process ended with code {process.exitcode}"))
                    say("file {}: {}".format(*findings[-1]))
                    tally["finding"] += 1
                    begin(numbers, skipped | {int(now[0])})
        for process, now, *_ in jobs.values():
            if _computed_s(process.pid) - now[1] > KILL_S or time.monotonic() - now[2] > STUCK_S:
                process.kill()
        if time.monotonic() - said > 30:
            said = time.monotonic()
            count_so_far = sum(tally.values())
            rate = count_so_far / (said - started)
            say(f"{count_so_far:,} files, {len(findings)} findings, {rate:,.0f} files/s")
    return {"first": first, "count": sum(tally.values()), "seed": seed, "processes": processes, "budget_bytes": budget,
            "seconds": time.monotonic() - started, "outcomes": dict(tally), "findings": sorted(findings)}  # fmt: skip


def keep(findings: Iterable[tuple[int, str]], seed: int, folder: Path, only: str = "") -> None:
    """Write the files of findings into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    starts = seeds(only)
    for number, _ in findings:
        (folder / f"{seed}-{number}.kpc").write_bytes(file_number(seed, number, starts))


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "fuzz", argv)


def _command(argv: list[str]) -> None:
    parser = fuzz_parser("fuzz", "Read files that are damaged in every way there is.", "files", 10_000)
    parser.add_argument("--processes", type=int, default=1, help="at a time (default: %(default)s)")
    parser.add_argument("--only", default="", metavar="NAME,...", help="vectors whose names begin so (default: all)")
    parser.add_argument(
        "--reader", choices=("python", "web"), default="python", help="which reads them (default: %(default)s)"
    )
    options = parser.parse_args(argv)
    check_range(options)
    if options.processes < 1:
        raise UsageError("--processes must be positive")
    if options.only and not seeds(options.only):
        raise UsageError(f"--only {options.only}: no vector's name begins so")
    found = run(
        options.count,
        options.seed,
        options.processes,
        budget=WEB_BUDGET if options.reader == "web" else BUDGET,
        say=lambda text: print(text, file=sys.stderr, flush=True),
        first=options.first,
        only=options.only,
        web=options.reader == "web",
    )
    if options.output is not None and found["findings"]:
        keep(found["findings"], options.seed, options.output, options.only)
    print(json.dumps(found, indent=1))
    if found["findings"]:
        raise KpcError(f"{len(found['findings'])} of {found['count']:,} files were neither read nor refused")


if __name__ == "__main__":
    sys.exit(main())
