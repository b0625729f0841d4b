"""The steps of kpbench suite: commands, what they need and make, and the minutes that they take on two cores."""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

from kpc.tools.bench import scaling, web_page

REPEATS = "3"  # of whatever is compared by time
DEFAULT = "default"  # the generated scene
LONG = "long"  # the generated clip in groups
BOX = "--box=" + ",".join(map(str, scaling.BOX))


@dataclass(frozen=True)
class Step:
    """A command.

    Attributes:
        name: of the step, and of its file of records.
        words: of the command of kpbench, without --out; where it has no records, of `python -m`.
        minutes: that it takes on two cores.
        needs: names of steps whose files it reads.
        makes: files and folders in the work folder that others read.
        has_records: whether it is a command of kpbench.
        missing: returns what this machine lacks for it; empty where nothing.
    """

    name: str
    words: tuple[str, ...]
    minutes: float
    needs: tuple[str, ...] = ()
    makes: tuple[str, ...] = ()
    has_records: bool = True
    missing: Callable[[], str] = str

    @property
    def file(self) -> str:
        """The name of the file of records."""
        return f"{self.name}.json"

    @property
    def command(self) -> tuple[str, ...]:
        """The command as people and records write it."""
        return ("kpbench", *self.words, "--out", self.file) if self.has_records else ("python", "-m", *self.words)

    @property
    def module(self) -> tuple[str, ...]:
        """What follows `python -m`."""
        return ("kpc.tools.bench.kpbench", *self.command[1:]) if self.has_records else self.words


@dataclass(frozen=True)
class Effort:
    """How much of everything is measured on generated scenes.

    Attributes:
        scene: options of scenegen for DEFAULT.
        long: those for LONG.
        group: duration of its groups.
        preset: of the encoding that is played.
        curves: minutes of training by preset.
        encode: options of the encodings by preset.
        steps: optimiser steps of ablations, scaling and groups.
        frames: that the player draws, and that a long playback does.
        views: held-out pictures of ablations.
        repeats: of whatever is compared by time.
        minutes: factor of the expected ones.
    """

    scene: tuple[str, ...]
    long: tuple[str, ...]
    group: str
    preset: str
    curves: dict[str, str]
    encode: tuple[str, ...]
    steps: tuple[int, int, int]
    frames: tuple[int, int]
    views: int
    repeats: str
    minutes: float


HOUR = Effort(
    scene=(),
    long=("--frames", "90", "--cameras", "8", "--size", "128x96", "--samples", "1"),
    group="2.5s",
    preset="balanced",
    curves={"fast": "1", "balanced": "1.5"},
    encode=(),
    steps=(200, 50, 200),
    frames=(20, 1000),
    views=4,
    repeats=REPEATS,
    minutes=1.0,
)
QUICK = Effort(
    scene=("--frames", "6", "--cameras", "4", "--size", "48x36", "--samples", "1"),
    long=("--frames", "24", "--cameras", "4", "--size", "48x36", "--samples", "1"),
    group="0.5s",
    preset="draft",
    curves={"draft": "0.02,0.05"},
    encode=("--steps", "30", "--test-views", "2"),
    steps=(5, 5, 20),
    frames=(3, 40),
    views=1,
    repeats="1",
    minutes=0.1,
)


def generated(effort: Effort) -> list[Step]:
    """Return the steps on generated scenes."""
    scenegen = ("kpc.tools.dev.scenegen",)
    long_clip = Step("scene-long", (*scenegen, LONG, *effort.long), 0.1, (), (f"{LONG}/gt/cameras.json",), False)
    scene = Step("scene", (*scenegen, DEFAULT, *effort.scene), 0.6, (), (f"{DEFAULT}/gt/cameras.json",), False)
    ablate_steps, scaling_steps, group_steps = map(str, effort.steps)
    main = f"kept/default-{effort.preset}"
    trained = Step(
        "encode",
        ("encode", DEFAULT, "--preset", effort.preset, *effort.encode, "--keep-scenes", "kept"),
        7,
        ("scene",),
        (f"{main}.kpc", f"{main}.kpck"),
    )
    fast = Step("encode-fast", ("encode", DEFAULT, "--preset", "fast", "--keep-scenes", "kept"), 2.2, ("scene",))
    # The coder is compared on the draft, since what it searches takes longest.
    coded = "kept/default-draft" + "-0" * (effort.repeats != "1")
    draft = Step(
        "encode-draft",
        ("encode", DEFAULT, "--preset", "draft", *effort.encode, "--repeats", effort.repeats, "--keep-scenes", "kept"),
        2.2,
        ("scene",),
        (f"{coded}.kpck",),
    )
    curves = [
        Step(
            f"curve-{preset}",
            ("curve", DEFAULT, "--preset", preset, "--minutes", minutes),
            {"draft": 3, "fast": 2.5, "balanced": 4.5}[preset],
            ("scene",),
        )
        for preset, minutes in effort.curves.items()
    ]
    ablate = ("ablate", DEFAULT, "--preset", "draft", "--steps", ablate_steps, "--test-views", str(effort.views), BOX)
    groups = (
        "groups",
        LONG,
        "--preset",
        "draft",
        "--steps",
        group_steps,
        "--group",
        effort.group,
    )
    steps = [
        scene,
        trained,
        draft,
        *([fast] if effort is HOUR else []),
        *curves,
        Step("ablate", ablate, 7, ("scene",)),
        Step("scaling", ("scaling", "--steps", scaling_steps, "--repeats", effort.repeats), 6),
        long_clip,
        Step("groups", (*groups, "--test-views", "12"), 0.8, ("scene-long",)),
        Step("step", ("step", DEFAULT, "--preset", effort.preset, "--repeats", effort.repeats), 3, ("scene",)),
        *_of_file("", f"{main}.kpc", "encode", effort.frames, effort.repeats),
        Step("codec", ("codec", f"{coded}.kpck", "--dataset", DEFAULT), 9, ("scene", "encode-draft")),
        Step("stability", ("stability",), 0.5),
        *_of_truth("", DEFAULT, f"{main}.kpc", ("scene", "encode"), effort.repeats),
    ]
    return [replace(step, minutes=round(step.minutes * effort.minutes, 2)) for step in steps]


def of_scene(name: str) -> list[Step]:
    """Return the steps on a dataset in the work folder, with all presets."""
    main, encode = f"kept-{name}/{name}-balanced-0", f"encode-{name}"
    kept = ("--keep-scenes", f"kept-{name}")
    encodings = [
        Step(
            encode if preset == "balanced" else f"{encode}-{preset}",
            ("encode", name, "--preset", preset, "--repeats", REPEATS, *kept),
            minutes,
            (),
            (f"{main}.kpc", f"{main}.kpck") if preset == "balanced" else (),
        )
        for preset, minutes in (("draft", 5), ("fast", 15), ("balanced", 35), ("best", 200))
    ]
    curve = ("curve", name, "--preset", "balanced", "--minutes", "1,2,5,10,20")
    return [
        *encodings,
        Step(f"curve-{name}", curve, 45),
        Step(f"ablate-{name}", ("ablate", name, "--preset", "fast", "--steps", "1000"), 60),
        Step(f"ceiling-{name}", ("ceiling", name, "--preset", "balanced"), 60),
        Step(f"step-{name}", ("step", name, "--repeats", REPEATS), 2),
        *_of_file(f"-{name}", f"{main}.kpc", encode, (60, 10_000)),
        Step(f"codec-{name}", ("codec", f"{main}.kpck", "--dataset", name, "--ablate"), 90, (encode,)),
        *_of_truth(f"-{name}", name, f"{main}.kpc", (encode,)),
    ]


def _of_file(end: str, file: str, encode: str, frames: tuple[int, int], repeats: str = REPEATS) -> list[Step]:
    """Return the steps that play a file; their names have an `end`."""
    timed = ("--repeats", repeats)
    player = [
        Step(
            f"player{end}-{size}",
            ("player", file, "--size", size, "--frames", str(frames[0]), *timed),
            minutes,
            (encode,),
        )
        for size, minutes in (("320x240", 1.3), ("640x480", 3.5))
    ]
    steady = ("steady", file, "--frames", str(frames[1]))
    return [
        *player,
        Step(f"stream{end}", ("stream", file, *timed), 0.2, (encode,)),
        Step(f"window{end}", ("window", file, "--seconds", "10", *timed), 1.6, (encode,), missing=_no_display),
        Step(f"steady{end}", steady, 0.4, (encode,), missing=_no_display),
        Step(f"web{end}", ("web", file), 5, (encode,), missing=_no_browser),
        Step(f"webload{end}", ("web", file, "--loading", *timed), 1.5, (encode,), missing=_no_browser),
    ]


def _of_truth(end: str, dataset: str, file: str, needs: tuple[str, ...], repeats: str = REPEATS) -> list[Step]:
    """Return the steps that decode a file and compare it with the truth; their names have an `end`."""
    return [
        Step(f"entropy{end}", ("entropy", file), 0.6, needs),
        Step(f"decode{end}", ("decode", file, "--repeats", repeats), 0.1, needs),
        Step(f"quality{end}", ("quality", file, dataset), 0.1, needs),
        Step(f"pictures{end}", ("pictures", file, dataset), 0.1, needs),
    ]


def _no_display() -> str:
    """Return that there is no display, on systems where windows need one."""
    has_display = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return "" if has_display else "needs a display"


def _no_browser() -> str:
    return web_page.missing() or ""
