"""kpbench pictures: held-out views as they are rendered, as they were filmed, and where the two differ."""

import base64
import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from kpc.encoder.evaluation.evaluate import Comparison
from kpc.encoder.evaluation.moving import MovingPixels
from kpc.format.common.errors import DatasetError
from kpc.format.container.groups import Groups
from kpc.tools.bench.group_joins import Shown
from kpc.tools.bench.quality import Job, dataset_of, held_out_frames

MOST_ACROSS = 640  # pixels of a picture that is kept; larger ones are averaged
QUALITY = 85  # of WebP
# Mean absolute error over the channels, as a share of the range, that an error map shows in full colour.
FULL_ERROR = 0.2
MOVING_COLOUR, STILL_COLOUR = (255, 150, 40), (70, 150, 255)


def measure(job: Job) -> dict[str, Any]:
    """Return the worst and the median of a scene's held-out views.

    Returns:
        `views`, each with `picture`, `truth` and `error` as WebP in base64, its `width` and `height`, `camera`,
        `frame`, `choice` and PSNR in dB of all, of moving and of still pixels (None where there are none); and
        `repeats`, with their means over all pictures that were compared.

    Raises:
        KpcError: the scene or the dataset cannot be used, or it holds out no picture.
    """
    with tempfile.TemporaryDirectory(prefix="kpbench-") as work:
        dataset = dataset_of(job, Path(work))
        moving = MovingPixels(dataset)
        number_of = {int(offset): number for number, offset in enumerate(dataset.pictures.offset)}
        views = [
            _view(shown, moving.mask(number_of[shown.key]))
            for shown in held_out_frames(Groups(job.scene), dataset, job.most)
        ]
    if not views:
        raise DatasetError(f"{job.dataset}: holds out no picture to compare with; give --holdout NAME")
    views.sort(key=lambda view: float(view["psnr"]))
    chosen = {"the worst": views[0], "the median": views[len(views) // 2]}
    means: dict[str, float | int | None] = {"pictures": len(views)}
    for name in ("psnr", "moving_psnr", "still_psnr"):
        values = [view[name] for view in views if view[name] is not None]
        means[name] = float(np.mean(values)) if values else None
    kept = [{"choice": f"{choice} of {len(views)}"} | view for choice, view in chosen.items()]
    return {"views": kept[: len(views)], "repeats": [means]}


def _view(shown: Shown, mask: np.ndarray | None) -> dict[str, Any]:
    found = shown.comparison
    parts = found.parts(mask)
    images = {"picture": found.picture, "truth": found.truth, "error": error_map(found, parts.get("moving"))}
    small = {name: _reduced(image) for name, image in images.items()}
    return {
        "camera": shown.name,
        "frame": shown.frame,
        "psnr": found.psnr(),
        **{f"{part}_psnr": found.psnr(parts[part]) if part in parts else None for part in ("moving", "still")},
        "width": small["truth"].width,
        "height": small["truth"].height,
        **{name: _webp(image) for name, image in small.items()},
    }


def error_map(found: Comparison, moving: np.ndarray | None) -> np.ndarray:
    """Return how far a picture is from the truth, (H, W, 3) in [0, 1]: black where it is not, or pixels do not count.

    Args:
        found: the picture and the truth.
        moving: (H, W) bool, the pixels that move, whose errors have MOVING_COLOUR; None where none is known to.
    """
    share = np.minimum(np.abs(found.error).mean(axis=-1) / FULL_ERROR, 1) * found.usable
    moves = np.zeros(share.shape, bool) if moving is None else moving
    colours = np.where(moves[..., None], MOVING_COLOUR, STILL_COLOUR) / 255
    return np.asarray(share[..., None] * colours, np.float32)


def _reduced(image: np.ndarray) -> Image.Image:
    """Return a picture with blocks of pixels averaged, so that it is at most MOST_ACROSS wide and high."""
    whole = Image.fromarray((255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8))
    return whole.reduce(max(1, -(-max(whole.size) // MOST_ACROSS)))


def _webp(image: Image.Image) -> str:
    written = io.BytesIO()
    image.save(written, "WEBP", quality=QUALITY)
    return base64.b64encode(written.getvalue()).decode()
