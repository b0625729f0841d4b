"""The subcommands of kpbench that play: player, stream, window, steady and web."""

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from typing import Any

from kpc.format.common import cli
from kpc.format.common.progress import progress
from kpc.format.container import scene_io
from kpc.player.quality import DEFAULT, LEVELS
from kpc.tools.bench import harness, pacing, playback_stability, player_bench, streaming_bench, web_bench, web_loading
from kpc.tools.bench.harness import size_text
from kpc.tools.bench.records import Record


def add_parsers(kinds: Any) -> None:
    """Add the subcommands to the subparsers `kinds`."""
    player = kinds.add_parser(
        "player", help="frame times and accuracy of all quality levels", description="Draw each scene offscreen."
    )
    harness.add_scenes(player)
    harness.add_size(player, (320, 240), "a frame")
    player.add_argument(
        "--frames", type=harness.positive, default=60, help="number of timed frames, one after the other (default: 60)"
    )
    player.set_defaults(measure=_player)

    stream = kinds.add_parser(
        "stream",
        help="scenes that play while they load",
        description="Measure how soon scenes appear from disk and over a slow link, how soon after a seek, and what "
        "prefixes of their files look like.",
    )
    harness.add_scenes(stream)
    harness.add_size(stream, (320, 240), "a picture")
    stream.set_defaults(measure=_stream)

    window = kinds.add_parser(
        "window",
        help="playback in a window with quality control",
        description="Measure the resolution and frame rate that a window chooses while it plays, and how near its "
        "pictures are to the reference. Needs a display.",
    )
    harness.add_scenes(window)
    harness.add_size(window, (800, 600), "the window")
    window.add_argument(
        "--seconds", type=harness.positive, default=20, metavar="S", help="duration to measure (default: 20)"
    )
    window.add_argument(
        "--turn",
        type=partial(cli.number_within, low=-3600, high=3600),
        default=0.0,
        metavar="DEGREES",
        help="degrees per second by which the camera orbits the scene meanwhile (default: 0)",
    )
    window.set_defaults(measure=_window)

    steady = kinds.add_parser(
        "steady",
        help="long playback in a window",
        description="Check that memory stays constant and that no graphics objects are created while scenes play in a "
        "window. Needs a display.",
    )
    harness.add_scenes(steady)
    harness.add_size(steady, (320, 240), "the window")
    steady.add_argument(
        "--frames", type=harness.positive, default=10_000, help="number of frames to draw (default: 10000)"
    )
    steady.set_defaults(measure=_steady)
    harness.add_repeats((player, stream, window, steady))

    web = kinds.add_parser(
        "web",
        help="what pictures in a browser look up, and how near they are to the reference",
        description="Draw each scene in headless Chromium by a software driver, count what pictures look up, and say "
        "which frame rate follows for graphics cards of several speeds. Needs a checkout, node and Chromium.",
    )
    harness.add_scenes(web)
    web.add_argument(
        "--size",
        type=harness.picture_size,
        nargs="+",
        default=[(320, 240), (1280, 720), (1920, 1080)],
        metavar="WxH",
        help="sizes of a picture; the software driver is timed at the first (default: 320x240 1280x720 1920x1080)",
    )
    web.add_argument(
        "--loading",
        action="store_true",
        help="measure instead how soon a page shows each scene over a line of 10 Mbit/s and 40 ms, beside a player of "
        "splats that shows a still scene of as many bytes",
    )
    harness.add_repeats((web,))
    web.set_defaults(measure=_web)


def _player(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield a record for each scene and quality level."""
    for source in options.scenes:
        scene_io.read(source)  # reports a damaged file before anything is measured
        common = {
            "size": size_text(options.size),
            "frames": options.frames,
            "warm_up": player_bench.WARM_UP,
            "default_quality": DEFAULT,
        }
        record = harness.new_record("player", source, origin, common)
        job = player_bench.Play(source, options.size, options.frames)
        print(f"kpbench: {record['name']}", file=sys.stderr)
        # Timing comes first: afterwards drivers have compiled shaders in their caches.
        repeats = [harness.isolated(player_bench.play_once, job) for _ in range(options.repeats)]
        renderer, accuracy = harness.isolated(player_bench.compare, job)
        for level, quality in LEVELS.items():
            settings = {"quality": level, **asdict(quality), **common}
            yield record | {
                "seed": None,
                "renderer": renderer,
                "settings": settings,
                "accuracy": accuracy[level],
                "repeats": [repeat[level] for repeat in repeats],
            }


def _stream(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record per scene: when it appears from disk and over a slow link, and the quality of its prefixes."""
    import kpc.encoder.coding.scene_writer  # noqa: F401  # reports a missing package before anything is measured

    for source in options.scenes:
        settings = {"size": size_text(options.size), "rate": streaming_bench.RATE, "delay": streaming_bench.DELAY}
        job = streaming_bench.Loading(source, options.size, LEVELS[DEFAULT])
        record = harness.new_record("stream", source, origin, settings)
        print(f"kpbench: {record['name']}", file=sys.stderr)
        repeats = [harness.isolated(streaming_bench.measure, job) for _ in range(options.repeats)]
        yield record | {
            "seed": None,
            "renderer": harness.isolated(player_bench.renderer_name, None),
            "repeats": repeats,
            "prefixes": harness.isolated(streaming_bench.prefixes, job),
        }


def _window(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record per scene: the frame rate, resolution and accuracy of a window under quality control."""
    for source in options.scenes:
        settings = {"size": size_text(options.size), "seconds": options.seconds, "turn": options.turn}
        job = pacing.Pacing(source, options.size, options.seconds, options.turn)
        record = harness.new_record("window", source, origin, settings)
        yield _in_window(record, options.repeats, pacing.measure, job)


def _steady(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield one record per scene: whether long playback in a window takes ever more memory."""
    for source in options.scenes:
        record = harness.new_record(
            "steady", source, origin, {"size": size_text(options.size), "frames": options.frames}
        )
        job = playback_stability.LongPlay(source, options.size, options.frames)
        yield _in_window(record, options.repeats, playback_stability.measure, job)


def _web(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield a record for each scene, size, and level or what `auto` makes of one; with --loading, for each player."""
    if options.loading:
        yield from _web_loading(options, origin)
        return
    for source in options.scenes:
        for number, size in enumerate(options.size):
            record = harness.new_record("web", source, origin, {})
            print(f"kpbench: {record['name']}, {size_text(size)}", file=sys.stderr)
            renderer, found = web_bench.measure(web_bench.Drawing(source, size, is_timed=number == 0))
            for (level, scale), measured in found.items():
                settings = {"quality": level, "scale": scale, "size": size_text(size), "devices": web_bench.DEVICES}
                yield record | {"seed": None, "renderer": renderer, "settings": settings, "repeats": [measured]}


def _web_loading(options: argparse.Namespace, origin: Record) -> Iterator[Record]:
    """Yield a record for each scene and player."""
    for source in options.scenes:
        record = harness.new_record("webload", source, origin, {})
        print(f"kpbench: {record['name']}, loading", file=sys.stderr)
        repeats = [web_loading.measure(source) for _ in progress(range(options.repeats), "loading", unit="repeats")]
        for player, first in repeats[0].items():
            settings = {"player": player, "size": size_text(web_loading.SIZE), "shows": first["shows"]}
            measured = [{key: value for key, value in found[player].items() if key != "shows"} for found in repeats]
            yield record | {"seed": None, "renderer": "SwiftShader", "settings": settings, "repeats": measured}


def _in_window(record: Record, repeats: int, measure: Callable[[Any], Record], job: object) -> Record:
    """Return the record with what `measure` returns, each repeat in a process of its own."""
    print(f"kpbench: {record['name']}", file=sys.stderr)
    found = [harness.isolated(measure, job) for _ in range(repeats)]
    return record | {"seed": None, "renderer": found[0].pop("renderer"), "repeats": found}
