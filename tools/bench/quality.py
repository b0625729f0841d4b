"""kpbench quality: how near a scene's pictures are to held-out ones, frame by frame, moving and still pixels apart.

Four measures, each of all pixels, of those that move and of the others (`kpc.encoder.evaluation.moving`):

* PSNR and SSIM (`kpc.encoder.evaluation.evaluate`);
* FLIP, the difference that a viewer perceives on flipping between two pictures (Andersson et al. 2020), 0 to 1, less is
  better. Unlike LPIPS, whose backbone is downloaded apart from its package, it has no trained weights, and it gives a
  value for each pixel, so that the mean over moving pixels is theirs alone;
* flicker, the RMS difference between the errors of a frame and of the one before, as a share of the range.
"""

import csv
import io
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.cli.metadata import hash_dataset
from kpc.encoder.datasets import Dataset, load_dataset
from kpc.encoder.evaluation.evaluate import Comparison, has_windows, spread_evenly, ssim, testable_pictures
from kpc.encoder.evaluation.moving import MovingPixels
from kpc.format.common.errors import DatasetError
from kpc.format.common.progress import progress
from kpc.format.container.groups import Groups
from kpc.tools.bench import tables
from kpc.tools.bench.group_joins import Shown, error_change, shown_frames

MEASURES = ("psnr", "ssim", "flip", "flicker")
PARTS = ("moving", "still")
# Rows of the table that is printed, and characters of a camera's name in it; all frames are in the JSON and CSV files.
ROWS, NAME = 40, 10


@dataclass(frozen=True)
class Job:
    """What to measure.

    Attributes:
        scene: the .kpc file.
        dataset: its folder.
        holdout: as for `load_dataset`.
        downscale: side of the blocks of pixels that are averaged.
        most: the most held-out pictures, None for all. Fewer than all are spread over time, which leaves no flicker.
    """

    scene: Path
    dataset: Path
    holdout: str | None = None
    downscale: int = 1
    most: int | None = None


@dataclass(frozen=True)
class Frame:
    """A held-out picture; None where something cannot be measured.

    Flicker needs the frame before from the same camera at the same place, `moving_` and `still_` at least three
    pictures of it.

    Attributes:
        camera: its name.
        frame: its number in the clip.
        moving_share: the share of its usable pixels that move.
        psnr: dB.
        ssim: mean over windows around such pixels.
        flip: mean FLIP error, 0 to 1; None where the package is not installed.
        flicker: change of the error since the frame before, RMS, as a share of the range.
    """

    camera: str
    frame: int
    moving_share: float | None
    psnr: float
    ssim: float | None
    flip: float | None
    flicker: float | None
    moving_psnr: float | None
    moving_ssim: float | None
    moving_flip: float | None
    moving_flicker: float | None
    still_psnr: float | None
    still_ssim: float | None
    still_flip: float | None
    still_flicker: float | None


def measure(job: Job) -> dict[str, Any]:
    """Compare a scene, or a clip in groups, with the held-out pictures of its dataset.

    Returns:
        `frames`, the fields of `Frame` for each picture, by camera and frame; and `means` over them, one for each
        field that any of them has a value of, with the number of `pictures`.

    Raises:
        KpcError: the scene or the dataset cannot be used, or it holds out no picture.
    """
    groups = Groups(job.scene)
    with tempfile.TemporaryDirectory(prefix="kpbench-") as work:
        dataset = dataset_of(job, Path(work))
        shown = held_out_frames(groups, dataset, job.most)
        found = sorted(measured_frames(shown, dataset), key=lambda frame: (frame.camera, frame.frame))
    if not found:
        raise DatasetError(f"{job.dataset}: holds out no picture to compare with; give --holdout NAME")
    frames = [asdict(frame) for frame in found]
    return {"frames": frames, "means": means(frames)}


def dataset_of(job: Job, work: Path) -> Dataset:
    """Load the dataset of a job into a folder; say so on stderr if the scene was made from another one."""
    dataset = load_dataset(job.dataset, work, holdout=job.holdout, downscale=job.downscale)
    made = Groups(job.scene).metadata().provenance
    is_as_encoded = job.downscale == int(made.get("options", {}).get("downscale", 1))
    if "dataset_sha256" in made and is_as_encoded and made["dataset_sha256"] != hash_dataset(dataset):
        name = job.dataset.resolve().name
        print(f"kpbench: warning: {job.scene.name} was made from other files than those of {name}", file=sys.stderr)
    return dataset


def held_out_frames(groups: Groups, dataset: Dataset, most: int | None) -> Iterator[Shown]:
    """Yield held-out pictures, those of a camera in the order of time."""
    held_out = testable_pictures(dataset, right_halves=bool(groups.open(0).appearances()))
    if most is not None and len(held_out):
        held_out = spread_evenly(dataset.pictures, held_out, most)
    wanted = set(dataset.pictures.offset[held_out].tolist())
    yield from progress(shown_frames(groups, dataset, wanted), "comparing", len(wanted), unit="pictures")


def measured_frames(pictures: Iterable[Shown], dataset: Dataset) -> Iterator[Frame]:
    """Measure held-out pictures of a dataset; flicker where a frame follows the one before."""
    moving = MovingPixels(dataset)
    number_of = {int(offset): number for number, offset in enumerate(dataset.pictures.offset)}
    before: dict[int, Shown] = {}
    for shown in pictures:
        found = shown.comparison
        parts = found.parts(moving.mask(number_of[shown.key]))
        last = before.get(shown.camera)
        change = None if last is None or last.frame != shown.frame - 1 else last.comparison.error
        before[shown.camera] = shown
        errors = flip_errors(found)
        figures = _measured(found, found.usable, errors, change)
        for part in PARTS:
            of_part = _measured(found, parts[part], errors, change) if part in parts else dict.fromkeys(MEASURES)
            figures |= {f"{part}_{name}": value for name, value in of_part.items()}
        share = float(parts["moving"].sum() / found.usable.sum()) if "moving" in parts else 0.0
        yield Frame(shown.name, shown.frame, share if parts else None, **figures)


def _measured(
    found: Comparison, where: np.ndarray, errors: np.ndarray | None, before: np.ndarray | None
) -> dict[str, Any]:
    """Return each of MEASURES over some pixels."""
    return {
        "psnr": found.psnr(where),
        "ssim": ssim(found.picture, found.truth, where) if has_windows(where) else None,
        "flip": None if errors is None else float(errors[where].mean(dtype=np.float64)),
        "flicker": None if before is None else error_change(found.error, before, where),
    }


def flip_errors(found: Comparison) -> np.ndarray | None:
    """Return the FLIP error of each pixel, (H, W) float32; None where its package is not installed.

    A pixel is as large as at 67 of them per degree, FLIP's default: a display 0.7 m wide with 3840 pixels across, seen
    from 0.7 m.
    """
    try:
        from flip_evaluator import evaluate
    except ModuleNotFoundError:
        return None
    truth, picture = (np.ascontiguousarray(image, np.float32) for image in (found.truth, found.picture))
    errors, _, _ = evaluate(truth, picture, "LDR", applyMagma=False, computeMeanError=False)
    return np.asarray(errors, np.float32)[..., 0]


def means(frames: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Return the mean of each measure over the frames that have it, and how many frames there are."""
    found: dict[str, float | None] = {"pictures": len(frames)}
    for field in fields(Frame)[2:]:
        values = [frame[field.name] for frame in frames if frame[field.name] is not None]
        found[field.name] = float(np.mean(values)) if values else None
    return found


def as_csv(records: Sequence[dict[str, Any]]) -> str:
    """Return all frames of `kpbench quality` records as CSV, a line each."""
    text = io.StringIO()
    writer = csv.DictWriter(text, ["name", *(field.name for field in fields(Frame))], lineterminator="\n")
    writer.writeheader()
    writer.writerows({"name": record["name"]} | frame for record in records for frame in record["frames"])
    return text.getvalue()


def frame_table(frames: Sequence[dict[str, Any]]) -> str:
    """Return the table of at most ROWS frames, evenly spread, as text of at most 100 columns; flicker of 255 levels."""
    head = ["camera", "frame", "moves", "PSNR", "moving", "still", "SSIM", "FLIP", "moving", "still"]
    head += ["flick", "moving", "still"]
    texts = {"psnr": ("{:.2f}", 1.0), "ssim": ("{:.3f}", 1.0), "flip": ("{:.3f}", 1.0), "flicker": ("{:.2f}", 255.0)}

    def cell(frame: dict[str, Any], key: str) -> str:
        text, unit = texts[key.rpartition("_")[2]]
        return "-" if frame[key] is None else text.format(unit * frame[key])

    rows = []
    for number in np.linspace(0, len(frames) - 1, min(len(frames), ROWS)).round().astype(int):
        frame = frames[number]
        share = frame["moving_share"]
        row = [frame["camera"][:NAME], str(frame["frame"]), "-" if share is None else f"{share:.0%}"]
        for measure_name in MEASURES:
            row.append(cell(frame, measure_name))
            if measure_name != "ssim":
                row += [cell(frame, f"{part}_{measure_name}") for part in PARTS]
        rows.append(row)
    left_out = f"\n({len(rows)} of {len(frames)} frames)" if len(rows) < len(frames) else ""
    return tables.aligned([head, *rows]) + left_out
