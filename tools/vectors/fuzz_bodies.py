"""Fuzz the decoder core alone: `python -m kpc.tools.vectors.fuzz_bodies --count 1000000 --seed 1 -o found`.

What the codecs of the conformance vectors store is mutated and decoded by the core, without the container around it:
twenty times as many a second as `kpc.tools.vectors.fuzz` examines files. The core must decode a body or refuse it with
a FormatError. Anything else that is raised, more than HANG_S of computing and more memory than the budget are findings.
Body number N of a seed is always the same, so that a run may be split by --first and --count.
"""

import json
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from kpc.format.coding.quantise import project_occupancy
from kpc.format.common import cli
from kpc.format.common.errors import FormatError, KpcError
from kpc.format.container.container import Codec
from kpc.format.container.groups import Groups
from kpc.format.container.scene_io import SceneReader
from kpc.format.core import core, decoding
from kpc.format.scene.scene import ALL_PLANES
from kpc.tools.dev.fuzz_options import check_range, fuzz_parser
from kpc.tools.vectors import specvectors
from kpc.tools.vectors.fuzz import BUDGET, HANG_S, LONG, scrambled

# How the core decodes chunks under the codecs of their own.
FUNCTIONS: dict[str, Callable[..., bytes]] = {
    "MOVE": decoding.decode_motion,
    "OCCU": decoding.decode_occupancy,
    "DECO": partial(decoding.decode_weights, False),
    "HYBR": partial(decoding.decode_weights, True),
    "came": decoding.decode_poses,
}
# A body is mutated so many times more with this probability each.
AGAIN = 0.15
REPORT_EVERY_S = 60.0


@dataclass(frozen=True)
class Body:
    """What a codec stores, and how the core decodes it or a mutation of it."""

    name: str
    stored: bytes
    decode: Callable[[bytes], object]


def bodies() -> list[Body]:
    """Return the bodies of the valid conformance vectors."""
    found: list[Body] = []
    for path, data in specvectors.files().items():
        if path.startswith("valid/") and Path(path).stem not in LONG:
            try:
                groups = Groups(data, allow_partial=True)
                readers = [groups.open(number) for number in range(len(groups)) if groups.available(number)]
            except FormatError:
                continue  # a vector that needs more memory than it gets here
            for reader in readers:
                found += _bodies_of(Path(path).stem, reader)
    return found


def _bodies_of(name: str, reader: SceneReader) -> Iterator[Body]:
    for number, entry in enumerate(reader.index):
        if not reader.available(number):
            continue
        title, is_raw = f"{name} {number} {entry.kind}", entry.codec in (Codec.RAW, Codec.ZSTD)
        if entry.kind == "PLNE":
            plane = reader.head.scales[entry.scale][ALL_PLANES[entry.plane]]
            rows = range(entry.row_start, entry.row_start + entry.row_count)
            projected = project_occupancy(reader.occupancy(), ALL_PLANES[entry.plane])
            decode: Callable[[bytes], object] = partial(
                decoding.decode_segment,
                Codec.RAW if is_raw else entry.codec,
                rows=len(rows),
                columns=plane.columns,
                channels=plane.channels,
                implied=decoding.implied_rows(projected, plane.rows, plane.columns, rows),
                memory_limit=BUDGET,
            )
            yield Body(title, reader.chunk(number) if is_raw else reader.context_coded(number), decode)
        elif not is_raw:
            decode = partial(FUNCTIONS[entry.kind], raw_length=entry.raw_length, memory_limit=BUDGET)
            yield Body(title, reader.context_coded(number), decode)


def body_number(seed: int, number: int, starts: list[Body]) -> tuple[Body, bytes]:
    """Return a body and its mutation."""
    rng = random.Random(f"bodies {seed}/{number}")
    start = rng.choice(starts)
    mutated = scrambled(rng, start.stored)
    while rng.random() < AGAIN:
        mutated = scrambled(rng, mutated)
    return start, mutated


def run(count: int, seed: int, first: int = 0, say: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Decode `count` mutated bodies from number `first` on; return the outcomes, and findings as [number, message]."""
    starts, tally, findings = bodies(), Counter[str](), []
    began = said = time.monotonic()
    slowest = 0.0
    for number in range(first, first + count):
        start, mutated = body_number(seed, number, starts)
        begun = time.process_time()
        try:
            start.decode(mutated)
            tally["decoded"] += 1
        except FormatError as error:
            tally[type(error).__name__] += 1
        except Exception as error:  # any other is a finding
            findings.append((number, f"{start.name}: {type(error).__name__}: {error}"))
        took_s = time.process_time() - begun
        slowest = max(slowest, took_s)
        if took_s > HANG_S:
            findings.append((number, f"{start.name}: took {took_s:.1f} s"))
        if any(one.size > BUDGET + decoding.CORE_BYTES + core.PAGE for one in core._idle):
            findings.append((number, f"{start.name}: took more memory than the budget"))
            core._idle.clear()
        if time.monotonic() - said > REPORT_EVERY_S:
            said = time.monotonic()
            say(f"{number + 1 - first:,} bodies, {len(findings)} findings, {dict(tally)}")
    return {"first": first, "count": count, "seed": seed, "bodies": len(starts), "seconds": time.monotonic() - began,
            "slowest_s": slowest, "outcomes": dict(tally), "findings": findings}  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "fuzz_bodies", argv)


def _command(argv: list[str]) -> None:
    parser = fuzz_parser("fuzz_bodies", "Decode damaged bodies of all codecs by the core.", "bodies", 10_000)
    options = parser.parse_args(argv)
    check_range(options)
    found = run(options.count, options.seed, options.first, lambda text: print(text, file=sys.stderr, flush=True))
    if options.output is not None and found["findings"]:
        options.output.mkdir(parents=True, exist_ok=True)
        starts = bodies()
        for number, _ in found["findings"]:
            (options.output / f"{options.seed}-{number}.body").write_bytes(body_number(options.seed, number, starts)[1])
    print(json.dumps(found, indent=1))
    if found["findings"]:
        raise KpcError(f"{len(found['findings'])} of {found['count']:,} bodies were neither decoded nor refused")


if __name__ == "__main__":
    sys.exit(main())
