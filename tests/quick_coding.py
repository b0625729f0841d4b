"""Coding with little effort, which suffices for tiny scenes: few rays, modes, passes, steps and views are tried."""

import importlib
import math
from collections.abc import Callable

import numpy as np

from kpc.encoder.rdo.curvature import PerPlane
from kpc.format.coding.quantise import QuantisedScene, quantise_scene
from kpc.format.scene.scene import Scene

# Constants by their full names.
SETTINGS = {
    "kpc.encoder.evaluation.validation_rays.VALIDATION_RAYS": 512,
    "kpc.encoder.rdo.curvature.RAYS": 1 << 11,
    "kpc.encoder.rdo.codec_model.BLOCK_SIDES": (8,),
    "kpc.encoder.rdo.codec_model.TOLERANCE": 0.05,
    "kpc.encoder.rdo.dct_rdo.PASSES": 2,
    "kpc.encoder.rdo.occupancy_rdo.FEWER_RAYS": 1 << 11,
    "kpc.encoder.rdo.occupancy_rdo.RAYS": 1 << 11,
    "kpc.encoder.rdo.rate_search.MAX_ATTEMPTS": 6,
    "kpc.encoder.rdo.trellis.PASSES": 2,
    "kpc.format.scene.view_limits.FARTHER": (1.5,),
    "kpc.format.scene.view_limits.JUDGED_WIDTH": 10,
    "kpc.format.scene.view_limits.MOST_CAMERAS": 6,
    "kpc.format.scene.view_limits.NEARER": (0.7,),
    "kpc.format.scene.view_limits.OPENING_ZOOMS": (1.0, 1.2, 1.5),
    "kpc.format.scene.view_limits.REACHES": (0.1, 0.3),
    "kpc.format.scene.view_limits.SEEN_WIDTH": 20,
    "kpc.format.scene.view_limits.STEP": math.radians(40),
}


def apply(assign: Callable[[object, str, object], None] = setattr) -> None:
    """Assign all settings."""
    for name, value in SETTINGS.items():
        module, constant = name.rsplit(".", 1)
        assign(importlib.import_module(module), constant, value)


def rounded(scene: Scene, steps: PerPlane, looked_up: np.ndarray, *_: object, **__: object) -> QuantisedScene:
    """Quantise in place of `quantise_by_cost`, without a search."""
    return quantise_scene(scene, steps, reached=looked_up)
