"""A contact sheet: truth, rendered, depth, row by row.

kprender scene.kpc --cameras gt/cameras.json --depth -o rendered
python -m kpc.tools.cli.contactsheet gt rendered -o sheet.png
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from kpc.format.common import cli
from kpc.format.common.errors import MediaError, UsageError
from kpc.format.common.fidelity import psnr
from kpc.format.common.media import IMAGE_SUFFIXES, read_image, write_image
from PIL import Image, ImageDraw, ImageFont

GAP = 6
CAPTION = 22
PAPER, INK = (250, 250, 248), (40, 40, 40)
NOTHING = 65535
"""In a depth PNG of kprender: no surface."""


@dataclass(frozen=True)
class Pair:
    """A true picture and the same view rendered, uint8 (H, W, 3); its depth, uint16 (H, W), where kprender wrote it."""

    name: str
    truth: np.ndarray
    rendered: np.ndarray
    depth: np.ndarray | None

    @property
    def psnr(self) -> float:
        """dB, on 8-bit values; 100 at most."""
        return psnr(self.truth / 255, self.rendered / 255)


def pairs(truth: Path, rendered: Path) -> list[Pair]:
    """The pictures of `rendered` that `truth` holds under the same name, whatever their suffixes.

    Raises:
        MediaError: there are none, one is damaged, or a pair differs in size.
    """
    true_files = {p.stem: p for p in sorted(truth.iterdir()) if p.suffix.lower() in IMAGE_SUFFIXES}
    found = []
    for file in sorted(rendered.glob("*.png")):
        if file.stem not in true_files:
            continue
        wanted, given = _on_white(read_image(true_files[file.stem])), _on_white(read_image(file))
        if wanted.shape != given.shape:
            sizes = f"is {_size(given)}, {true_files[file.stem]} is {_size(wanted)}"
            raise MediaError(f"{file}: {sizes}; render without --size")
        found.append(Pair(file.stem, wanted, given, _depth(file.with_name(f"{file.stem}_depth.png"))))
    if not found:
        raise MediaError(f"{rendered}: no picture has the name of one in {truth}; render with --cameras of {truth}")
    return found


def sheet(rows: list[Pair], labels: dict[str, float]) -> np.ndarray:
    """Truth, rendered and depth beside each other, a row for each pair, names and dB below; uint8 (H, W, 3).

    Args:
        labels: PSNR in dB by name.
    """
    with_depth = all(pair.depth is not None for pair in rows)
    heads = ["truth", "rendered"] + ["depth"] * with_depth
    width, height = max(p.truth.shape[1] for p in rows), max(p.truth.shape[0] for p in rows)
    columns, step = len(heads), height + CAPTION
    page = Image.new("RGB", (GAP + columns * (width + GAP), len(rows) * step + GAP), PAPER)
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(13)
    for y, pair in zip(range(GAP, page.height, step), rows):
        pictures = [pair.truth, pair.rendered] + ([_grey(pair.depth)] if with_depth and pair.depth is not None else [])
        captions = [f"{pair.name}  {heads[0]}", f"{heads[1]}  {labels[pair.name]:.1f} dB", *heads[2:]]
        for x, picture, caption in zip(range(GAP, page.width, width + GAP), pictures, captions):
            page.paste(Image.fromarray(picture), (x, y))
            draw.text((x, y + picture.shape[0] + 1), caption, INK, font)
    return np.asarray(page)


def _on_white(picture: np.ndarray) -> np.ndarray:
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:] / 255
    return np.rint(picture[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)


def _depth(file: Path) -> np.ndarray | None:
    if not file.is_file():
        return None
    with Image.open(file) as image:
        return np.asarray(image).astype(np.uint16)


def _grey(depth: np.ndarray) -> np.ndarray:
    """Near is light, far is dark, nothing is black; stretched to what this picture holds."""
    there = depth != NOTHING
    if not there.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = np.percentile(depth[there], (1, 99))
    light = 1 - 0.85 * np.clip((depth - near) / max(far - near, 1.0), 0, 1)
    return np.repeat(np.rint(255 * np.where(there, light, 0)).astype(np.uint8)[..., None], 3, axis=2)


def _size(picture: np.ndarray) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "contactsheet", argv)


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser("contactsheet", description="Put rendered pictures beside the true ones.")
    parser.add_argument("truth", type=Path, help="folder of true pictures")
    parser.add_argument("rendered", type=Path, help="folder that kprender --cameras wrote, with --depth or without")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PNG")
    parser.add_argument("--rows", type=int, default=4, help="at most, evenly spaced (default: 4)")
    options = parser.parse_args(argv)
    for folder in (options.truth, options.rendered):
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder")
    if options.rows < 1:
        raise UsageError(f"--rows {options.rows} is not positive")
    found = pairs(options.truth, options.rendered)
    quality = {pair.name: pair.psnr for pair in found}
    chosen = sorted({round(k) for k in np.linspace(0, len(found) - 1, min(options.rows, len(found)))})
    write_image(options.output, sheet([found[k] for k in chosen], quality))
    print(f"{options.output}: mean PSNR {np.mean(list(quality.values())):.2f} dB over {len(found)} pictures")


if __name__ == "__main__":
    sys.exit(main())
