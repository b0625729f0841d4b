"""Appearance embeddings: which pictures share a code, its name, and the code of a picture that was not trained on.

Pictures of one scene may disagree about its colours. An appearance is a code that is added to the hidden layer of the
direction MLP (`kpc.format.scene.scene.Decoder`): it changes colours, never geometry (K-Planes, arXiv:2301.10241,
section 3.3).
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kpc.encoder.datasets import Dataset
from kpc.encoder.field.adam import Adam
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import march_scene
from kpc.encoder.field.render import Rays, shade
from kpc.format.common.errors import UsageError
from kpc.format.common.text import agreeing, counted
from kpc.format.container.scene_layout import APPEARANCE_LIMIT, is_valid_name
from kpc.format.scene.scene import Scene

# Rays of a picture by which its code is fitted.
FIT_RAYS = 1024

# Steps and learning rate of Adam (measured: docs/design/training.md).
FIT_STEPS = 100
FIT_RATE = 0.05

# Samples of a smaller weight are left out of the fit.
FIT_MIN_WEIGHT = 1e-3


def choose_appearance(dataset: Dataset) -> tuple[str, str]:
    """Return whether each training picture gets an appearance ("image") or none does ("none"), and the reason.

    They get one in a photo collection: nothing moves, and most pictures have a lens or size that no other has.
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
    share = f"{alone} of {counted(total, 'picture')}"
    why = f"{share} {agreeing(alone, 'has a lens or size of its', 'have a lens or size of their')} own"
    if 2 * alone <= total or total > APPEARANCE_LIMIT:
        return "none", why
    return "image", f"photographs: {why}"


def assign_appearances(dataset: Dataset, kind: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Assign appearances to the training pictures.

    Args:
        kind: "image": one for each picture; "camera": one for each camera; "none".

    Returns:
        The appearance of each picture, (P,) int64, -1 for none (held-out pictures, too); and their distinct names.

    Raises:
        UsageError: there are more than a file holds.
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
    """Number the frames of each video: "cam00.mp4#0", "cam00.mp4#1", ..."""
    last: dict[str, int] = {}
    out = []
    for file in files:
        last[file] = last.get(file, -1) + 1
        out.append(f"{file}#{last[file]}")
    return out


def _storable(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names, with numbers for those that a file cannot hold or that occur before."""
    out: dict[str, None] = {}
    for number, name in enumerate(names):
        while not is_valid_name(name) or name in out:
            name, number = f"#{number}", number + len(names)
        out[name] = None
    return tuple(out)


def fit_code(scene: Scene, field: Field, rays: Rays, targets: Tensor) -> np.ndarray:
    """Fit the code with which a scene shows rays most nearly in given colours: 0, then FIT_STEPS steps of Adam.

    Args:
        field: `Field.from_scene(scene)`, which is not changed. rays: N rays. targets: (N, 3) colours in [0, 1].

    Returns:
        (H,) float32; the same rays give the same code.
    """
    code = torch.zeros(len(scene.decoder.b1), requires_grad=True)
    if not len(targets):
        return code.detach().numpy()
    with torch.no_grad():
        _, weighed = march_scene(field, rays, scene)
        kept = weighed.weights > FIT_MIN_WEIGHT
        weighed = replace(weighed, **{name: getattr(weighed, name)[kept] for name in ("ray", "latent", "weights")})
    optimiser = Adam([{"params": [code], "lr": FIT_RATE}])
    for _ in range(FIT_STEPS):
        optimiser.zero_grad()
        (shade(field, rays, weighed, code) - targets).square().mean().backward()
        optimiser.step()
    return code.detach().numpy()
