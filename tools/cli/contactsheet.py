"""contactsheet: put rendered pictures beside the true ones, with PSNR and depth.

kprender scene.kpc --cameras gt/cameras.json --depth -o rendered
python -m kpc.tools.cli.contactsheet gt rendered -o sheet.png
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from kpc.format.common import cli
from kpc.format.common.errors import MediaError, UsageError
from kpc.format.common.fidelity import psnr
from kpc.format.common.images import read_image, write_image
from kpc.format.common.media_files import is_image
from kpc.format.common.text import counted, escaped, notice
from kpc.tools.cli.depth_images import NO_SURFACE, depth_path, read_depth_levels

# Space between pictures, and height of a caption, in pixels.
GAP = 6
CAPTION = 22

# Suffixes of the sheet.
SHEET_SUFFIXES = (".png", ".jpg", ".jpeg")

# Colours of the page and of the captions.
PAPER, INK = (250, 250, 248), (40, 40, 40)


@dataclass(frozen=True)
class Pair:
    """A true picture and the same view rendered, and its depth where kprender wrote it."""

    name: str
    truth: np.ndarray  # (H, W, 3) uint8
    rendered: np.ndarray  # (H, W, 3) uint8
    depth: np.ndarray | None  # (H, W) uint16 levels of a depth PNG

    @property
    def psnr(self) -> float:
        """PSNR in dB of the 8-bit values, at most 100."""
        return psnr(self.truth / 255, self.rendered / 255)


def pairs(truth: Path, rendered: Path) -> tuple[list[Pair], list[Path]]:
    """Pair the pictures of two folders by name, regardless of their suffixes. Nothing is paired by order.

    Returns:
        The pairs, and the pictures that have no partner.

    Raises:
        MediaError: there is no pair, two pictures of a folder differ in their suffixes alone, a picture is damaged, or
            the sizes of a pair differ.
    """
    true_files, files = _by_stem(truth), _by_stem(rendered)
    depths = {depth_path(file).stem for file in files.values()}
    files = {stem: file for stem, file in files.items() if stem not in depths}
    found = []
    for stem, file in files.items():
        if stem not in true_files:
            continue
        wanted, given = _on_white(read_image(true_files[stem])), _on_white(read_image(file))
        if wanted.shape != given.shape:
            sizes = f"is {_size(given)}, {true_files[stem]} is {_size(wanted)}"
            raise MediaError(f"{file}: {sizes}; render without --size")
        found.append(Pair(stem, wanted, given, _depth_levels(file)))
    if not found:
        raise MediaError(f"{rendered}: no picture has the name of one in {truth}; render with --cameras of {truth}")
    alone = [file for stem, file in files.items() if stem not in true_files]
    return found, alone + [file for stem, file in true_files.items() if stem not in files]


def _by_stem(folder: Path) -> dict[str, Path]:
    """Return the pictures of a folder by their names without suffix."""
    found: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        if not is_image(file):
            continue
        if (other := found.setdefault(file.stem, file)) != file:
            raise MediaError(f"{file}: {other.name} has the same name; which one is meant? Move one elsewhere")
    return found


def sheet(rows: list[Pair], labels: dict[str, float]) -> np.ndarray:
    """Return a page (H, W, 3) uint8 with a row for each pair: truth, rendered and depth, with captions below.

    Args:
        rows: the pairs to show; depth is shown if all of them have one.
        labels: PSNR in dB by name.
    """
    with_depth = all(pair.depth is not None for pair in rows)
    heads = ["truth", "rendered"] + ["depth"] * with_depth
    width, height = max(p.truth.shape[1] for p in rows), max(p.truth.shape[0] for p in rows)
    step = height + CAPTION
    page = Image.new("RGB", (GAP + len(heads) * (width + GAP), len(rows) * step + GAP), PAPER)
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(13)
    for number, pair in enumerate(rows):
        y = GAP + number * step
        pictures = [pair.truth, pair.rendered]
        if with_depth and pair.depth is not None:
            pictures.append(_grey(pair.depth))
        captions = [f"{pair.name}  {heads[0]}", f"{heads[1]}  {labels[pair.name]:.1f} dB", *heads[2:]]
        for column, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
            x = GAP + column * (width + GAP)
            page.paste(Image.fromarray(picture), (x, y))
            draw.text((x, y + picture.shape[0] + 1), caption, INK, font)
    return np.asarray(page)


def _on_white(picture: np.ndarray) -> np.ndarray:
    """Composite a picture with alpha over white."""
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:] / 255
    return np.rint(picture[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)


def _depth_levels(picture: Path) -> np.ndarray | None:
    """Return the depth that kprender wrote beside a picture; None if there is none."""
    file = depth_path(picture)
    return read_depth_levels(file) if file.is_file() else None


def _grey(depth: np.ndarray) -> np.ndarray:
    """Show depth in grey, stretched to the range of the picture: near is light, far is dark, no surface is black."""
    there = depth != NO_SURFACE
    if not there.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = np.percentile(depth[there], (1, 99))
    light = 1 - 0.85 * np.clip((depth - near) / max(far - near, 1.0), 0, 1)
    return np.repeat(np.rint(255 * np.where(there, light, 0)).astype(np.uint8)[..., None], 3, axis=2)


def _size(picture: np.ndarray) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "contactsheet", argv)


def _command(argv: list[str]) -> None:
    parser = cli.Parser("contactsheet", description="Put rendered pictures beside the true ones.")
    cli.add_version_option(parser)
    parser.add_argument("truth", type=cli.named_path, help="folder of true pictures")
    parser.add_argument(
        "rendered", type=cli.named_path, help="folder that kprender --cameras wrote, with or without --depth"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=cli.output_file(*SHEET_SUFFIXES),
        required=True,
        metavar="PNG",
        help="the .png or .jpg to write",
    )
    parser.add_argument(
        "--rows", type=int, default=4, help="number of rows at most, evenly spaced over all pairs (default: 4)"
    )
    options = parser.parse_args(argv)
    cli.check_writable(options.output)
    for folder in (options.truth, options.rendered):
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder")
        if options.output.absolute().parent.samefile(folder):
            raise UsageError(f"{options.output}: would lie among the pictures of {folder}; put the sheet elsewhere")
    if options.rows < 1:
        raise UsageError(f"--rows {options.rows} is not positive")
    found, alone = pairs(options.truth, options.rendered)
    if alone:
        others = f" and {counted(len(alone) - 1, 'other')}" if len(alone) > 1 else ""
        notice(f"contactsheet: {alone[0]}{others}: no partner of that name, left out")
    quality = {pair.name: pair.psnr for pair in found}
    chosen = sorted({round(k) for k in np.linspace(0, len(found) - 1, min(options.rows, len(found)))})
    write_image(options.output, sheet([found[k] for k in chosen], quality))
    mean = np.mean(list(quality.values()))
    print(escaped(f"{options.output}: mean PSNR {mean:.2f} dB over {counted(len(found), 'picture')}"))


if __name__ == "__main__":
    sys.exit(main())
