"""How options are named in which a checkpoint and its continuation differ."""

from dataclasses import asdict

import torch

from kpc.encoder.field.config import PRESETS, TrainConfig
from kpc.encoder.training.continuation import name_changes


def settings(**changes):
    return {"config": asdict(TrainConfig(**changes)), "aabb": torch.zeros(2, 3), "mapping": "None"}


def test_changed_options_are_named_with_both_values():
    moving = settings(moving_area=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6))
    assert name_changes(settings(), settings(steps=7, tune_steps=1)) == name_changes(moving, moving) == ""
    assert name_changes(settings(), moving).startswith(
        "--layers was one, is auto, with scales of its own for what moves"
    )
    assert name_changes(moving, settings(seed=3)).endswith("; --seed was 0, is 3")
    assert name_changes(settings(), {**settings(), "mapping": "NDC"}) == "--space was None, is NDC"
    presets = ({**settings(), "config": asdict(PRESETS[name])} for name in ("draft", "paper"))
    assert name_changes(*presets) == "--preset was draft, is paper"
