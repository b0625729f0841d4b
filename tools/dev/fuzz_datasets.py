"""Fuzz the dataset loaders: `python -m kpc.tools.dev.fuzz_datasets --count 20000 --seed 1 -o found`.

Tiny datasets of every layout are mutated: the values, keys and names of JSON documents, the words of texts (COLMAP,
YAML, TOML, XML), the bytes of COLMAP's models, the numbers of `poses_bounds.npy`, and the files themselves.
`load_dataset` must read the result or refuse it with a DatasetError or MediaError. Everything that it says must be
printable lines, and of the media files each must be trained on, held out or left out. Anything else, and more than
HANG_S of computing, are findings, whose datasets are written to -o. Dataset number N of a seed is always the same.
"""

import contextlib
import faulthandler
import io
import json
import os
import random
import shutil
import signal
import struct
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from kpc.encoder.datasets import load_dataset
from kpc.encoder.datasets.left_out import media_in
from kpc.encoder.datasets.plausibility import doubts
from kpc.format.common import cli
from kpc.format.common.errors import DatasetError, KpcError, MediaError
from kpc.format.common.films import write_video
from kpc.format.common.images import write_image
from kpc.format.common.progress import progress
from kpc.format.scene.camera_models import COLMAP_NUMBERS, PARAMETERS
from kpc.tools.dev.fuzz_options import check_range, fuzz_parser
from kpc.tools.dev.fuzz_rigs import rigs
from kpc.tools.vectors.fuzz import scrambled

HANG_S = 5.0  # seconds of processor time that count as a hang
STUCK_S = 120.0  # seconds after which the process prints where it is and ends, since no exception gets through

WIDTH, HEIGHT, CAMERAS = 8, 6, 5

TEXTS = (".txt", ".yml", ".toml")  # suffixes of documents that are changed word by word

HOLDOUTS = (None, None, None, "none", "1")  # what is asked to be held out, in turn

Files = dict[str, bytes]  # the content of a dataset's files by their paths
Mutation = Callable[[random.Random, Files], None]

NUMBERS = (
    *(0, -1, 1, 2, 1e-320, 1e-30, 1e-9, 1e-6, 0.5, 179.9, 1e3, 1e9, 1e30, 1e300, 2**31, 2**64, 10**400, -0.0),
    *(float("nan"), float("inf"), -float("inf")),
)
STRANGE: tuple[Any, ...] = (
    *(None, True, False, "", "5", "nan", [], {}, [1], [[]], {"a": 1}, "\0", "\x1b[31m\n", "\ud800", "x" * 5000),
)
MODELS: tuple[Any, ...] = (
    *PARAMETERS,
    "EQUIRECTANGULAR",
    "opencv",
    "SIMPLE",
    "",
    " PINHOLE",
    "PINHOLE\n",
    4,
    0,
    None,
    [],
    "\x1b[1m",
)
WORDS = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "1", "1e-320", "1e300", "9" * 400, "9" * 5000, "0x10", "1_0", "x", "#"),
    *("PINHOLE", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "\x1b[31m", "\x85", "\u2028", "é", "", "-1 -1 -1", "\0"),
)
KEYS = (
    *("k1", "k2", "k3", "k4", "p1", "p2", "cx", "w", "h", "fl_x", "fl_y", "near", "far", "time", "fps", "mask_path"),
    *("camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "camera_model", "camera_type", "distortion_params"),
    *("is_fisheye", "from_na", "applied_transform", "enable_ray_loading", "frames", "file_path", "transform_matrix"),
    *("train_filenames", "val_filenames", "test_filenames", "\x1b[31m", "", "unknown"),
)
NAMES = (
    *("", ".", "..", "/", "../images/0.png", "/etc/passwd", "images", "images/0", "images/0.PNG", "images\\1.png"),
    *(
        "images/./2.png",
        "images//3.png",
        "images/../images/4.png",
        "images/none.png",
        "images/0.png ",
        "\0",
        "a\nb.png",
    ),
    *("images/\x1b[31m.png", "images/é.png", "images/e\u0301.png", "images/\udcff.png", "images/\ud800.png"),
    *("x" * 300, "x/" * 3000, "images/0.txt", "images/._0.png", "transforms.json"),
)
FILE_NAMES = ("00.png", "a b.png", "é.PNG", "\x1b[31m.png", "a\nb.png", "\udcff.png", "x.JPG", "n.txt", "1a.png")


# --- the datasets that are mutated


def seeds() -> list[Files]:
    """Return tiny valid datasets of every layout."""
    with tempfile.TemporaryDirectory() as folder:
        root, rng = Path(folder), np.random.default_rng(0)
        for n in range(CAMERAS):
            write_image(root / f"{n}.png", rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
            if n < 3:
                frames = rng.integers(0, 256, (3, 2 * HEIGHT, 2 * WIDTH, 3), np.uint8)
                write_video(root / f"cam{n}.mp4", iter(frames), 8.0)
        images = {f"images/{n}.png": (root / f"{n}.png").read_bytes() for n in range(CAMERAS)}
        videos = {f"cam{n}.mp4": (root / f"cam{n}.mp4").read_bytes() for n in range(3)}
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": 9.0, "fl_y": 9.0, "cx": 4.0, "cy": 3.0, "k1": 0.01, "fps": 8}
    names = [f"images/{n}.png" for n in range(CAMERAS)]
    lists = {"train_filenames": names[2:4], "val_filenames": names[:1], "test_filenames": names[1:2]}
    splits = {
        f"transforms_{split}.json": _json({"camera_angle_x": 0.8, "frames": [_frame(n) for n in numbers]})
        for split, numbers in (("train", (0, 1)), ("val", (2,)), ("test", (3, 4)))
    }
    posed = [_frame(n) for n in range(CAMERAS)]
    return [
        images | {"transforms.json": _json(lens | {"frames": posed})},
        images | {"transforms.json": _json(lens | lists | {"camera_model": "OPENCV", "frames": posed})},
        images | splits,
        images | _colmap_binary("OPENCV", (9.0, 9.0, 4.0, 3.0, 0.01, 0.0, 0.0, 0.0)),
        images | _colmap_text("PINHOLE 8 6 9 9 4 3"),
        images | {"poses_bounds.npy": _array(_poses_bounds(CAMERAS, 1))},
        videos | {"poses_bounds.npy": _array(_poses_bounds(3, 2))},
        *rigs(CAMERAS, WIDTH, HEIGHT, images),
    ]


def _json(document: Any) -> bytes:
    return json.dumps(document).encode()


def _frame(number: int) -> dict[str, Any]:
    pose = [[1.0, 0.0, 0.0, float(number)], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    return {"file_path": f"images/{number}.png", "transform_matrix": pose, "time": number / (CAMERAS - 1)}


def _colmap_binary(model: str, parameters: tuple[float, ...]) -> Files:
    number = next(number for number, name in COLMAP_NUMBERS.items() if name == model)
    images = b"".join(
        struct.pack("<I7dI", n + 1, 1, 0, 0, 0, n, 0, 0, 7)
        + f"{n}.png".encode()
        + struct.pack("<xQ", n)
        + bytes(24 * n)
        for n in range(CAMERAS)
    )
    cameras = struct.pack(f"<QIiQQ{len(parameters)}d", 1, 7, number, WIDTH, HEIGHT, *parameters)
    return {"sparse/0/cameras.bin": cameras, "sparse/0/images.bin": struct.pack("<Q", CAMERAS) + images}


def _colmap_text(camera: str) -> Files:
    lines = "".join(f"{n + 1} 1 0 0 0 {n} 0 0 7 {n}.png\n{'1.5 2.5 -1 ' * n}\n" for n in range(CAMERAS))
    return {"sparse/0/cameras.txt": f"# cameras\n7 {camera}\n".encode(), "sparse/0/images.txt": lines.encode()}


def _poses_bounds(count: int, scale: int) -> np.ndarray:
    """Return rows of cameras in a line for pictures of `scale` times the usual size."""
    rows = np.zeros((count, 17))
    rows[:, [1, 5, 12]], rows[:, [4, 9, 14, 15, 16]] = (1, -1, 1), (scale * HEIGHT, scale * WIDTH, scale * 9, 1, 6)
    rows[:, 3] = np.arange(count)
    return rows


def _array(values: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, values)
    return out.getvalue()


# --- mutations


def of_json(rng: random.Random, files: Files) -> None:
    """Replace, delete, add or repeat values and keys of a document, or set its lists, names or camera model."""
    name = _chosen(rng, files, ".json")
    try:
        document = json.loads(files[name])
    except (ValueError, RecursionError):
        return in_bytes(rng, files)
    for _ in range(rng.choice((1, 1, 2, 3))):
        places = list(_places(document))
        if not places:
            break
        place, key = rng.choice(places)
        match rng.randrange(8):
            case 0:
                place[key] = rng.choice(NUMBERS)
            case 1 if isinstance(place[key], float):  # an integer may be too large for a product
                place[key] *= rng.choice((0.5, 0.999, 1.001, 1.5, -1))
            case 2:
                place[key] = rng.choice(STRANGE)
            case 3:
                del place[key]
            case 4 if isinstance(place, list):
                place.insert(rng.randrange(len(place) + 1), rng.choice([place[key], rng.choice(NUMBERS)]))
            case 4 | 5:
                _set_key(rng, document)
            case 6:
                names = [(p, k) for p, k in places if isinstance(p[k], str)] or places
                place, key = rng.choice(names)
                place[key] = rng.choice(NAMES)
            case _:
                other, another = rng.choice(places)
                place[key] = json.loads(json.dumps(other[another]))
    text = json.dumps(document)
    if rng.random() < 0.05 and '"' in text:
        at = rng.choice([k for k, letter in enumerate(text) if letter == "{"] or [0])
        text = text[: at + 1] + f"{json.dumps(rng.choice(KEYS))}: 1, " * 2 + text[at + 1 :]
    files[name] = text.encode("utf-8", "surrogatepass")


def _set_key(rng: random.Random, document: Any) -> None:
    """Set a key of the document or one of its frames to something that may be meant."""
    frames = document.get("frames") if isinstance(document, dict) else None
    places = [p for p in [document, *(frames if isinstance(frames, list) else ())] if isinstance(p, dict)]
    if not places:
        return
    key = rng.choice(KEYS)
    if key.endswith("_filenames"):
        value: Any = rng.choices([*(f"images/{n}.png" for n in range(CAMERAS)), *NAMES], k=rng.randrange(5))
    elif key in ("camera_model", "camera_type"):
        value = rng.choice(MODELS)
    elif key in ("mask_path", "file_path"):
        value = rng.choice(NAMES)
    elif key == "distortion_params":
        value = [rng.choice((0, 0.01, rng.choice(NUMBERS))) for _ in range(rng.choice((4, 6)))]
    else:
        value = rng.choice((0.01, 1, rng.choice(NUMBERS), rng.choice(STRANGE)))
    rng.choice(places)[key] = value


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield container and key of every value within a document."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


def of_words(rng: random.Random, files: Files) -> None:
    """Replace, delete, repeat or exchange words and lines of a text file."""
    name = rng.choice([name for name in files if name.endswith(TEXTS)])
    lines = [line.split(" ") for line in files[name].decode("utf-8", "replace").split("\n")]
    for _ in range(rng.choice((1, 1, 2, 3))):
        line = rng.choice(lines) if lines else []
        at = rng.randrange(len(line) or 1)
        match rng.randrange(8):
            case 0 if lines:
                lines.remove(line)
            case 1:
                lines.insert(rng.randrange(len(lines) + 1), list(line))
            case 2:
                del line[at : at + 1]
            case 3:
                line.insert(at, rng.choice(WORDS))
            case 4:
                line[at : at + 1] = [rng.choice(NAMES)]
            case _:
                line[at : at + 1] = [rng.choice(WORDS)]
    files[name] = "\n".join(" ".join(line) for line in lines).encode("utf-8", "surrogatepass")


def of_array(rng: random.Random, files: Files) -> None:
    """Replace numbers of an array, or its shape or type."""
    name = _chosen(rng, files, ".npy")
    try:
        rows = np.load(io.BytesIO(files[name]))
    except Exception:  # NumPy raises many kinds about what an earlier mutation broke
        return in_bytes(rng, files)
    if rows.dtype != np.float64 or not rows.size:
        return in_bytes(rng, files)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.randrange(rows.size)
        scale = rng.choice((0.5, 0.999, 1.001, 1.5, -1))
        rows.flat[at] = float(min(rng.choice(NUMBERS), 1e308)) if rng.random() < 0.5 else rows.flat[at] * scale
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        match rng.randrange(12):
            case 0:
                rows = rows[: rng.randrange(len(rows) + 1)]
            case 1:
                rows = rows.ravel()
            case 2:
                rows = rows.astype(rng.choice(("f4", "f2", "i4", "u1", "c16", "S8", "U5", ">f8", "?", "M8[s]")))
            case 3:
                rows = np.concatenate([rows, rows])
            case 4:
                rows = rows[None] if rng.random() < 0.5 else rows.T
    files[name] = _array(rows)


def in_bytes(rng: random.Random, files: Files) -> None:
    """Change bytes of a file, mostly of one that describes cameras; or cut it off."""
    described = [name for name in files if not name.endswith((".png", ".mp4"))]
    images = [name for name in files if name.endswith(".png")]
    name = rng.choice(images if images and (not described or rng.random() < 0.1) else described or list(files))
    data = files[name]
    files[name] = data[: rng.randrange(len(data) + 1)] if rng.random() < 0.1 else scrambled(rng, data)


def of_files(rng: random.Random, files: Files) -> None:
    """Rename, delete or copy a file."""
    name = rng.choice(list(files))
    folder, _, last = name.rpartition("/")
    other = f"{folder}/{rng.choice(FILE_NAMES)}".removeprefix("/")
    match rng.randrange(4):
        case 0:
            del files[name]
        case 1:
            files[other] = files[name]
        case 2:
            files[f"masks/{last}"] = files[rng.choice(list(files))]
        case _:
            files[other] = files.pop(name)


def of_names(rng: random.Random, files: Files) -> None:
    """Rename an image or video, also where files of cameras name it."""
    name = rng.choice([name for name in files if name.endswith((".png", ".mp4"))] or list(files))
    folder, _, last = name.rpartition("/")
    stem = rng.choice(FILE_NAMES).rpartition(".")[0]
    new = f"cam{stem}.mp4" if last.endswith(".mp4") else f"{stem}.png"
    files[f"{folder}/{new}".removeprefix("/")] = files.pop(name)
    for other, data in files.items():
        if other.endswith((".json", ".txt", ".bin")):
            written = json.dumps(new)[1:-1].encode() if other.endswith(".json") else os.fsencode(new)
            files[other] = data.replace(os.fsencode(last), written)


def _chosen(rng: random.Random, files: Files, suffix: str) -> str:
    return rng.choice([name for name in files if name.endswith(suffix)])


def mutated(rng: random.Random, seed: Files) -> Files:
    """Return a dataset mutated once, seldom several times."""
    files = dict(seed)
    while True:
        fit: list[Mutation] = [
            mutation
            for suffix, mutation in ((".json", of_json), (TEXTS, of_words), (".npy", of_array), ("", in_bytes))
            if any(name.endswith(suffix) for name in files)
        ]
        weights = [6] * (len(fit) - 1) + [3] if fit else []
        chosen = rng.choices([*fit, of_names, of_files], [*weights, 1, 1])[0] if files else None
        if chosen is not None:
            chosen(rng, files)
        if chosen is None or rng.random() < 0.8:
            return files


# --- trying them


class Hang(BaseException):
    """Loading took longer than HANG_S."""


def examined(root: Path, cache: Path, holdout: str | None = None) -> str:
    """Load a dataset; return "read" or the name of the error that refused it.

    Raises:
        Anything but a DatasetError or MediaError: a finding.
    """
    said = io.StringIO()
    with _watched(), contextlib.redirect_stderr(said):
        try:
            dataset = load_dataset(root, cache, holdout=holdout, progress=False)
            outcome, lines = "read", [dataset.describe(), *doubts(dataset)]
        except (DatasetError, MediaError) as error:
            outcome, lines = type(error).__name__, [str(error)]
    for line in (*lines, *said.getvalue().removesuffix("\n").split("\n")):
        if not line.isprintable():
            raise AssertionError(f"not a printable line: {ascii(line)[:200]}")
    if outcome == "read":
        pictures = dataset.pictures
        used = len(set(pictures.file))
        folder = next((root / name for name in ("images", "rgb/1x") if (root / name).is_dir()), root)
        found = len(media_in(folder))
        if used + dataset.left_out != found:
            raise AssertionError(f"{used} trained on or held out and {dataset.left_out} left out of {found} found")
    return outcome


@contextlib.contextmanager
def _watched() -> Iterator[None]:
    """Raise Hang after HANG_S of computing where the system can, and end the process after STUCK_S."""

    def ring(*_: object) -> None:
        raise Hang(f"took more than {HANG_S:g} s")

    faulthandler.dump_traceback_later(STUCK_S, exit=True, file=sys.__stderr__ or sys.stderr)
    has_timer = hasattr(signal, "setitimer")
    before = signal.signal(signal.SIGPROF, ring) if has_timer else None
    try:
        if has_timer:
            signal.setitimer(signal.ITIMER_PROF, HANG_S)
        yield
    finally:
        if has_timer:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.signal(signal.SIGPROF, before)
        faulthandler.cancel_dump_traceback_later()


def write(files: Files, folder: Path) -> None:
    """Write a dataset into a new folder."""
    folder.mkdir(parents=True)
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def number(seed: int, n: int, starts: list[Files]) -> Files:
    """Return the dataset with a number, which depends on nothing but its arguments."""
    rng = random.Random(f"{seed}/{n}")
    return mutated(rng, rng.choice(starts))


def run(count: int, seed: int, first: int = 0, shown: bool = False) -> tuple[Counter[str], list[tuple[int, str]]]:
    """Examine `count` datasets from number `first` on; return the outcomes, and the findings by number."""
    starts, outcomes, findings = seeds(), Counter[str](), []
    with tempfile.TemporaryDirectory() as folder:
        for n in progress(range(first, first + count), "fuzz", unit="dataset", shown=shown):
            files, root = number(seed, n, starts), Path(folder) / "set"
            shutil.rmtree(root, ignore_errors=True)
            write(files, root)
            try:
                outcomes[examined(root, Path(folder) / "cache", HOLDOUTS[n % len(HOLDOUTS)])] += 1
            except (Exception, Hang) as error:  # any exception but the two that refuse is a finding
                outcomes["finding"] += 1
                findings.append((n, f"{type(error).__name__}: {error}"))
    return outcomes, findings


def main(argv: list[str] | None = None) -> int:
    return cli.run(_command, "fuzz_datasets", argv)


def _command(argv: list[str]) -> None:
    parser = fuzz_parser("fuzz_datasets", "Load datasets that are damaged in many ways.", "datasets", 1000)
    options = parser.parse_args(argv)
    check_range(options)
    outcomes, findings = run(options.count, options.seed, options.first, shown=True)
    for n, what in findings:
        print(f"dataset {n}: {what}", file=sys.stderr)
        if options.output is not None:
            write(number(options.seed, n, seeds()), options.output / f"{options.seed}-{n}")
    print(json.dumps(outcomes, indent=1))
    if findings:
        raise KpcError(f"{len(findings)} of {options.count:,} datasets were neither read nor refused as they should be")


if __name__ == "__main__":
    sys.exit(main())
