"""Appearances: which pictures share a code, what it is called, and which code a picture has that was not trained on.

Pictures of one scene may disagree about its colours. Each appearance is a code that shifts the hidden layer of the direction MLP
(`kpc.format.scene.scene.Decoder`): it reaches colours alone, never geometry (K-Planes, arXiv:2301.10241, section 3.3).
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from kpc.encoder.datasets import Dataset
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import march_scene
from kpc.encoder.field.render import Rays, shade
from kpc.format.common.errors import UsageError
from kpc.format.container.scene_layout import APPEARANCE_LIMIT, is_valid_name
from kpc.format.scene.scene import Scene
from torch import Tensor

FIT_RAYS = 1024
"""Of a picture, that tell its code."""
FIT_STEPS = 100
FIT_RATE = 0.05
"""Of Adam. The ball of `TrainConfig.appearance_learning_rate` has 25.4 dB with 0.02, 25.5 with 0.05 and 0.1, and 25.6 after 300
steps."""
FIT_MIN_WEIGHT = 1e-3
"""Samples of a smaller weight have no say."""


def choose_appearance(dataset: Dataset) -> tuple[str, str]:
    """Whether every training picture has an appearance of its own ("image") or none has ("none"), and why, in words for the log.

    They have where they are a photo collection: nothing moves, and most of them have a lens or size that no other has.
    """
    pictures = dataset.pictures
    if dataset.is_dynamic:
        return "none", "a clip, filmed as one"
    train = ~pictures.is_test
    lenses = np.concatenate(
        [pictures.intrinsics[train], pictures.width[train, None], pictures.height[train, None]], axis=1
    )
    _, counts = np.unique(lenses, axis=0, return_counts=True)
    alone, total = int((counts == 1).sum()), len(lenses)
    if 2 * alone <= total or total > APPEARANCE_LIMIT:
        return "none", f"{alone} of {total} pictures have a lens or size of their own"
    return "image", f"photographs: {alone} of {total} pictures have a lens or size of their own"


def assign_appearances(dataset: Dataset, kind: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """The appearance of each picture, (P,) int64, -1 where it has none because it is held out or `kind` is "none"; and the names,
    all different. With "camera", pictures of one camera share theirs; with "image", none do.

    Raises:
        UsageError: they are more than a file holds.
    """
    pictures = dataset.pictures
    numbers, train = np.full(len(pictures), -1, np.int64), np.flatnonzero(~pictures.is_test)
    if kind == "none":
        return numbers, ()
    if kind == "camera":
        cameras, first, numbers[train] = np.unique(pictures.camera[train], return_index=True, return_inverse=True)
        files = [pictures.file[p] for p in train[first]]
        names = [[dataset.camera_names[c] for c in cameras], files]
    else:
        numbers[train] = np.arange(len(train))
        files = [pictures.file[p] for p in train]
        names = [[Path(file).name for file in files], files, _counted(files)]
    if len(files) > APPEARANCE_LIMIT:
        remedy = "give --appearance camera" if kind == "image" else "give --appearance none"
        raise UsageError(
            f"--appearance {kind}: would be {len(files):,} appearances, a file holds {APPEARANCE_LIMIT:,}; {remedy}"
        )
    return numbers, _storable(next((some for some in names if len(set(some)) == len(some)), names[-1]))


def _counted(files: list[str]) -> list[str]:
    """A video's frames told apart: "cam00.mp4#0", "cam00.mp4#1", ..."""
    seen: dict[str, int] = {}
    out = []
    for file in files:
        seen[file] = seen.get(file, -1) + 1
        out.append(f"{file}#{seen[file]}")
    return out


def _storable(names: Sequence[str]) -> tuple[str, ...]:
    """The names, but a number where a file cannot hold one (`kpc.format.container.scene_io.is_valid_name`) or has it already."""
    out: dict[str, None] = {}
    for number, name in enumerate(names):
        while not is_valid_name(name) or name in out:
            name, number = f"#{number}", number + len(names)
        out[name] = None
    return tuple(out)


def fit_code(scene: Scene, field: Field, rays: Rays, targets: Tensor) -> np.ndarray:
    """The code with which a scene shows rays most nearly as (N, 3) `targets`: (H,) float32, from 0 by FIT_STEPS steps of Adam on
    the mean squared error, all else frozen. The same rays give the same code. `field`: `Field.from_scene(scene)`.
    """
    code = torch.zeros(len(scene.decoder.b1), requires_grad=True)
    if not len(targets):
        return code.detach().numpy()
    with torch.no_grad():
        _, met = march_scene(field, rays, scene)
        seen = met.weights > FIT_MIN_WEIGHT
        met = replace(met, ray=met.ray[seen], latent=met.latent[seen], weights=met.weights[seen])
    optimiser = torch.optim.Adam([code], lr=FIT_RATE)
    for _ in range(FIT_STEPS):
        optimiser.zero_grad()
        (shade(field, rays, met, code) - targets).square().mean().backward()
        optimiser.step()
    return code.detach().numpy()
