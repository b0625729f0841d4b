"""Draw the figures of docs/capture.md: `python -m kpc.tools.dev.capture_figures docs`.

capture-rig.svg        a rig from above: cameras on an arc, each a few degrees from the next
capture-overlap.svg    what two neighbours see of one subject, close together and far apart
capture-clap.svg       a clap in the sound of three cameras, and how much moves, before and after they are in step
"""

import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from kpc.format.common import cli

STYLE = (
    "<style>svg{background:#fff;font:13px system-ui,sans-serif}text{fill:#1d2329}.faint{fill:#68737d}"
    ".camera{fill:#0b66c3}.field{fill:#0b66c3;fill-opacity:.07;stroke:#0b66c3;stroke-opacity:.3;stroke-width:.7}"
    ".subject{fill:#c8590b}.line{fill:none;stroke:#68737d;stroke-width:1}.curve{fill:none;stroke:#0b66c3}"
    ".mark{stroke:#c8590b;stroke-width:1.5;stroke-dasharray:4 3}</style>"
)
FIELD = 25.0  # half of the angle that a camera sees, degrees


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "capture_figures", argv)


def _command(argv: list[str]) -> None:
    parser = cli.Parser("capture_figures", description="Draw the figures of docs/capture.md.")
    parser.add_argument("folder", type=cli.named_path, help="where the figures are written")
    folder = parser.parse_args(argv).folder
    for name, draw in FIGURES.items():
        with cli.atomic_write(folder / name) as aside:
            Path(aside).write_text(draw())


def _svg(width: int, height: int, label: str, parts: list[str]) -> str:
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" aria-label="{label}">'
    return "\n".join([head, STYLE, *parts, "</svg>", ""])


def _text(x: float, y: float, words: str, kind: str = "", anchor: str = "middle") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}" class="{kind}">{words}</text>'


def _camera(x: float, y: float, towards: float, reach: float) -> str:
    """Draw a camera and what it sees; `towards` in degrees, 0 to the right and 90 down."""
    edges = [math.radians(towards + side) for side in (-FIELD, FIELD)]
    field = " ".join(f"{x + reach * math.cos(edge):.1f},{y + reach * math.sin(edge):.1f}" for edge in edges)
    return (
        f'<polygon class="field" points="{x:.1f},{y:.1f} {field}"/>'
        f'<rect class="camera" x="-7" y="-5" width="14" height="10" rx="2" '
        f'transform="translate({x:.1f} {y:.1f}) rotate({towards:.1f})"/>'
    )


def _arc(subject: tuple[float, float], radius: float, angles: list[float], reach: float) -> list[str]:
    """Draw cameras on an arc below a subject, by their angles in degrees from straight below."""
    drawn = []
    for angle in angles:
        a = math.radians(angle)
        x, y = subject[0] + radius * math.sin(a), subject[1] + radius * math.cos(a)
        drawn.append(_camera(x, y, -90 - angle, reach))
    return [*drawn, f'<circle class="subject" cx="{subject[0]}" cy="{subject[1]}" r="13"/>']


def rig() -> str:
    """Return the figure of a rig from above."""
    subject, radius = (320.0, 120.0), 270.0
    angles = [-36.0 + 8 * number for number in range(10)]
    parts = ['<rect class="line" x="120" y="30" width="400" height="4"/>', _text(320, 24, "wall with posters")]
    parts += _arc(subject, radius, angles, 330)
    for angle in angles[4:6]:
        a = math.radians(angle)
        end = subject[0] + radius * math.sin(a), subject[1] + radius * math.cos(a)
        parts.append(f'<path class="line" d="M{subject[0]} {subject[1]}L{end[0]:.1f} {end[1]:.1f}"/>')
    parts += [
        _text(338, 260, "8°", anchor="start"),
        _text(320, 96, "subject"),
        _text(320, 428, "ten cameras on an arc, all looking at the subject", "faint"),
    ]
    return _svg(640, 440, "Ten cameras on an arc, 8 degrees apart as seen from the subject", parts)


def overlap() -> str:
    """Return the figure of neighbours close together and far apart."""
    parts = []
    for middle, apart, verdict, why in (
        (160.0, 10.0, "10° apart: good", "both see nearly the same side"),
        (480.0, 40.0, "40° apart: too wide", "features no longer match"),
    ):
        parts += _arc((middle, 70.0), 190.0, [-apart / 2, apart / 2], 240)
        parts += [_text(middle, 304, verdict), _text(middle, 322, why, "faint")]
    return _svg(640, 334, "Two neighbours 10 degrees apart, and two 40 degrees apart", parts)


def clap() -> str:
    """Return the figure of three cameras' sound and motion around a clap."""
    rng = np.random.default_rng(1)
    late = (0.0, 0.35, -0.2)  # seconds by which their clocks are wrong
    times = np.linspace(0, 2, 140)
    parts = []
    for column, (left, title) in enumerate(((30.0, "as filmed"), (340.0, "in step"))):
        parts.append(_text(left + 135, 20, title))
        for row, by in enumerate(late):
            shown = times - (by if column == 0 else 0.0)
            sound = rng.standard_normal(len(times)) * (0.06 + np.where(shown > 1, np.exp(-(shown - 1) / 0.08), 0))
            moves = 0.25 + 0.2 * np.sin(5 * shown) + 0.9 * np.exp(-(((shown - 0.97) / 0.05) ** 2))
            top = 40 + 95 * row
            for middle, values, scale in ((top + 22, np.clip(sound, -1, 1), 20.0), (top + 75, moves, 24.0)):
                x = left + 270 * times / 2
                points = " ".join(f"{a:.1f},{middle - scale * b:.1f}" for a, b in zip(x, values, strict=True))
                parts.append(f'<polyline class="curve" points="{points}"/>')
            if column == 0:
                parts.append(_text(left - 4, top + 52, f"{row + 1}", "faint", "end"))
            mark = left + 135 * (1 + (by if column == 0 else 0.0))
            parts.append(f'<path class="mark" d="M{mark:.1f} {top - 2}V{top + 84}"/>')
    parts.append(_text(320, 344, "sound, and below it how much moves, of three cameras; dashed: the clap", "faint"))
    return _svg(640, 356, "A clap in three cameras, before and after their clocks are in step", parts)


FIGURES: dict[str, Callable[[], str]] = {
    "capture-rig.svg": rig,
    "capture-overlap.svg": overlap,
    "capture-clap.svg": clap,
}

if __name__ == "__main__":
    sys.exit(main())
