"""A page that shows where cameras stand, what they see, and how well they were found: `cameras.html`.

It is one file without scripts: drawings are SVG, pictures are small JPEG files in data URIs.
"""

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image

from kpc.encoder.datasets.dataset import Dataset
from kpc.encoder.poses.orientation import looked_at, up_direction
from kpc.format.common.cli import atomic_write, check_writable
from kpc.format.common.errors import UsageError

# At most so many cameras are labelled, have a picture, or are drawn; where there are more, some of them.
LABELS, PICTURES, DRAWN, POINTS = 24, 24, 400, 2500
# Sides of the drawings and widths of the pictures, in pixels; cameras are drawn by this share of a side.
SIDE, WIDTH, CAMERA = 440, 200, 0.05

# By this a page is known for one that may be replaced.
GENERATOR = '<meta name="generator" content="kpc cameras">'

STYLE = """
:root{color-scheme:light dark;--ink:#1d2329;--faint:#68737d;--line:#d5dade;--page:#fff;--camera:#0b66c3;--point:#9aa4ad}
@media(prefers-color-scheme:dark){:root{--ink:#e4e8eb;--faint:#98a3ad;--line:#39424a;--page:#14181c;--camera:#6db3ff;
--point:#65717b}}
body{margin:0 auto;max-width:960px;padding:16px;font:15px/1.45 system-ui,sans-serif;color:var(--ink);
background:var(--page)}
h1{font-size:1.3rem;overflow-wrap:anywhere}h2{font-size:1rem;margin:1.6em 0 .5em}p{color:var(--faint)}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,300px),1fr));gap:16px}
figure{margin:0;min-width:0}figcaption{color:var(--faint);font-size:.85rem;overflow-wrap:anywhere}
svg{width:100%;height:auto;border:1px solid var(--line);border-radius:6px;display:block}
.camera{fill:none;stroke:var(--camera)}circle{fill:var(--point)}svg text{fill:var(--ink);font-size:11px}
.curve{fill:none;stroke:var(--camera);stroke-width:1}
.wide{overflow-x:auto}table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.9rem}
th,td{text-align:left;padding:3px 14px 3px 0;border-bottom:1px solid var(--line);white-space:nowrap}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(130px,1fr));gap:10px}
.over{position:relative}.over svg{position:absolute;inset:0;height:100%;border:0}
.check{fill:none;stroke-width:1.5;vector-effect:non-scaling-stroke}
.grid img{width:100%;border-radius:4px;display:block}
"""


@dataclass(frozen=True)
class Check:
    """A point in a picture, and where another camera that sees it says that it is.

    Attributes:
        place: x and y in pixels.
        line: (N, 2) pixels, its epipolar line; it goes through the point if both cameras were placed rightly.
    """

    place: tuple[float, float]
    line: np.ndarray


@dataclass(frozen=True)
class ShownCamera:
    """A camera on the page.

    Attributes:
        name: of the camera, or of the picture of a moving one.
        pose: (4, 4) camera to world, OpenGL convention; None if it was not placed.
        lens: focal lengths and principal point in pixels: fl_x fl_y cx cy.
        size: width and height in pixels.
        facts: what the table says about it, by column.
        picture: (H, W, 3) uint8, or None.
        checks: drawn on the picture.
    """

    name: str
    pose: np.ndarray | None
    lens: tuple[float, float, float, float]
    size: tuple[int, int]
    facts: tuple[str, ...] = ()
    picture: np.ndarray | None = None
    checks: tuple[Check, ...] = ()


@dataclass(frozen=True)
class Curve:
    """How much moves in a video: the times of its frames in the clip, in seconds, and the motion before each; (N,)."""

    name: str
    times: np.ndarray
    motion: np.ndarray


def check_page(file: Path) -> None:
    """Refuse a name of a page under which another file lies: it stays.

    Raises:
        UsageError: one does that this module did not write.
        OSError: it cannot be written.
    """
    check_writable(file)
    if file.exists() and GENERATOR not in file.read_text(encoding="utf-8", errors="replace"):
        raise UsageError(f"{file}: is no page of KPC and stays; move it, or write beside another -o")


def write_camera_page(
    file: Path,
    title: str,
    lines: Sequence[str],
    cameras: Sequence[ShownCamera],
    columns: Sequence[str] = (),
    points: np.ndarray | None = None,
    curves: Sequence[Curve] = (),
    up: np.ndarray | None = None,
) -> None:
    """Write the page.

    Args:
        file: of the page.
        title: its heading.
        lines: paragraphs below it.
        cameras: those that are shown.
        columns: headings of their facts.
        points: (N, 3) of the scene, drawn with the cameras; None if unknown.
        curves: of motion, one below another; what belongs together is in line if clocks are right.
        up: (3,) unit vector, the direction that is up in the drawings; None for what the cameras say.
    """
    parts = [f"<h1>{escape(title)}</h1>", *(f"<p>{escape(line)}</p>" for line in lines)]
    placed = [camera for camera in cameras if camera.pose is not None]
    if placed:
        parts.append(_drawings(placed, np.zeros((0, 3)) if points is None else points, up))
    if columns:
        rows = "".join(
            f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in (camera.name, *camera.facts))}</tr>"
            for camera in cameras
        )
        head = "".join(f"<th>{escape(cell)}</th>" for cell in ("camera", *columns))
        parts.append(f'<h2>Cameras</h2><div class="wide"><table><tr>{head}</tr>{rows}</table></div>')
    if curves:
        parts.append(_curves(curves))
    shown = "".join(
        f"<figure>{_picture(camera)}<figcaption>{escape(camera.name)}</figcaption></figure>"
        for camera in cameras
        if camera.picture is not None
    )
    if shown:
        parts.append(f'<h2>Pictures</h2><div class="grid">{shown}</div>')
        if any(camera.checks for camera in cameras):
            parts.append(
                "<p>Circles: points that were found. Lines of the same colour: where they lie for the camera that "
                "shares most points. Each line goes through its circle if cameras were placed rightly.</p>"
            )
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"{GENERATOR}"
        f"<title>{escape(title)}</title><style>{STYLE}</style><body>{''.join(parts)}</body></html>\n"
    )
    with atomic_write(file) as aside:
        Path(aside).write_text(page, encoding="utf-8", errors="replace")


def spread(count: int, most: int) -> list[int]:
    """Return at most `most` of `count` numbers, evenly spread."""
    return sorted({int(n) for n in np.linspace(0, count - 1, min(count, most)).round()})


def write_page_of_dataset(file: Path, dataset: Dataset, lines: Sequence[str]) -> None:
    """Write the page of a dataset whose poses were given."""
    pictures = dataset.pictures
    _, first = np.unique(pictures.camera, return_index=True)
    numbers = np.sort(first)
    with_picture = {int(numbers[k]) for k in spread(len(numbers), PICTURES)}
    cameras = [
        ShownCamera(
            dataset.camera_names[int(pictures.camera[n])],
            pictures.camera_to_world[n],
            tuple(pictures.intrinsics[n].tolist()),
            (int(pictures.width[n]), int(pictures.height[n])),
            picture=dataset.pixels.picture(n)[..., :3] if n in with_picture else None,
        )
        for n in numbers.tolist()
    ]
    write_camera_page(file, f"Cameras of {dataset.path.name}", lines, cameras)


def _drawings(cameras: Sequence[ShownCamera], points: np.ndarray, up_in_world: np.ndarray | None) -> str:
    poses = np.stack([camera.pose for camera in cameras if camera.pose is not None])
    axes = _axes(poses, up_direction(poses) if up_in_world is None else up_in_world)
    some = points[spread(len(points), POINTS)] if len(points) else points
    reach = np.concatenate([poses[:, :3, 3], some]) @ axes.T
    low, high = np.quantile(reach, 0.02, axis=0), np.quantile(reach, 0.98, axis=0)
    centres = poses[:, :3, 3] @ axes.T
    seen = looked_at(poses)
    shown_too = np.concatenate([centres, [seen @ axes.T]])
    low, high = np.minimum(low, shown_too.min(0)), np.maximum(high, shown_too.max(0))
    half = 0.56 * float((high - low).max()) or 1.0
    middle = (low + high) / 2
    shown = [cameras[n] for n in spread(len(cameras), DRAWN)]
    labelled = {id(shown[n]) for n in spread(len(shown), LABELS)}
    figures = []
    for across, up, caption in ((0, 1, "From above"), (1, 2, "From the side")):
        frame = np.stack([axes[across], -axes[up]])  # pixels run down
        shift = np.array([middle[across], -middle[up]])

        def place(at: np.ndarray, frame: np.ndarray = frame, shift: np.ndarray = shift) -> np.ndarray:
            return SIDE / 2 * (1 + (at @ frame.T - shift) / half)

        dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="0.8"/>' for x, y in place(some) if 0 <= min(x, y) <= SIDE)
        x, y = place(seen[None])[0]
        dots += f'<path class="camera" d="M{x - 5:.1f} {y:.1f}h10M{x:.1f} {y - 5:.1f}v10"/>'
        drawn = "".join(
            _camera(camera, place, CAMERA * 2 * half, up == 1 and id(camera) in labelled) for camera in shown
        )
        figures.append(
            f'<figure><svg viewBox="0 0 {SIDE} {SIDE}" role="img" aria-label="{caption}">{dots}{drawn}</svg>'
            f"<figcaption>{caption}; the cross is where the cameras look</figcaption></figure>"
        )
    return f'<div class="pair">{"".join(figures)}</div>'


def _axes(poses: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return rows right, forwards and up, (3, 3)."""
    forward = -poses[:, :3, 2].mean(0)
    forward = forward - (forward @ up) * up
    if np.linalg.norm(forward) < 0.05:  # cameras all around
        forward = np.linalg.svd(up[None])[2][1]
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(forward, up), forward, up])


def _camera(camera: ShownCamera, place: Callable[[np.ndarray], np.ndarray], depth: float, is_labelled: bool) -> str:
    """Draw the pyramid that a camera sees."""
    assert camera.pose is not None
    (fx, fy, cx, cy), (width, height) = camera.lens, camera.size
    local = [((x - cx) / fx, (cy - y) / fy, -1.0) for x, y in ((0, 0), (width, 0), (width, height), (0, height))]
    centre = camera.pose[:3, 3]
    corners = place(centre + depth * np.array(local) @ camera.pose[:3, :3].T)
    eye = place(centre[None])[0]
    outline = "".join(f"M{eye[0]:.1f} {eye[1]:.1f}L{x:.1f} {y:.1f}" for x, y in corners)
    outline += "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in corners) + "Z"
    beside = f'x="{eye[0] - 4:.1f}" text-anchor="end"' if eye[0] > 0.75 * SIDE else f'x="{eye[0] + 4:.1f}"'
    name = f'<text {beside} y="{eye[1] - 4:.1f}">{escape(camera.name)}</text>' if is_labelled else ""
    return f'<path class="camera" d="{outline}"/>{name}'


def _curves(curves: Sequence[Curve]) -> str:
    row, width, left = 22, 900, 90
    first, last = min(c.times[0] for c in curves), max(c.times[-1] for c in curves)
    span = max(float(last - first), 1e-9)
    drawn = []
    for number, curve in enumerate(curves):
        values = np.log(curve.motion[1:] + 0.1 * float(curve.motion.mean()) + 1e-3)
        values = (values - values.min()) / max(float(np.ptp(values)), 1e-9)
        x = left + (curve.times[1:] - first) / span * (width - left - 10)
        y = (number + 0.9) * row - 0.75 * row * values
        line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
        drawn.append(
            f'<text x="6" y="{(number + 0.8) * row:.0f}">{escape(curve.name[:14])}</text>'
            f'<polyline class="curve" points="{line}"/>'
        )
    return (
        '<h2>How much moves, at the time of the clip</h2><div class="wide">'
        f'<svg viewBox="0 0 {width} {len(curves) * row + 6}" style="min-width:600px">{"".join(drawn)}</svg></div>'
        "<p>Rises and falls stand one below another if the clocks are right.</p>"
    )


def _picture(camera: ShownCamera) -> str:
    """Return the picture of a camera, with its checks."""
    assert camera.picture is not None
    image = f'<img alt="" src="{_jpeg(camera.picture)}">'
    if not camera.checks:
        return image
    height, width = camera.picture.shape[:2]
    drawn = ""
    for number, check in enumerate(camera.checks):
        hue = f"stroke:hsl({90 * number + 30} 90% 55%)"
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in check.line)
        x, y = check.place
        drawn += (
            f'<polyline class="check" style="{hue}" points="{line}"/>'
            f'<circle class="check" style="{hue}" cx="{x:.1f}" cy="{y:.1f}" r="{0.022 * width:.1f}"/>'
        )
    return f'<div class="over">{image}<svg viewBox="0 0 {width} {height}">{drawn}</svg></div>'


def _jpeg(picture: np.ndarray) -> str:
    image = Image.fromarray(picture)
    image.thumbnail((WIDTH, WIDTH))
    data = io.BytesIO()
    image.save(data, "JPEG", quality=70)
    return f"data:image/jpeg;base64,{base64.b64encode(data.getvalue()).decode()}"
