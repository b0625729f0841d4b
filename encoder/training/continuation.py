"""What an interrupted run and its continuation have in common, and in which options of kpenc they differ."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from kpc.encoder.field.config import PRESETS

# What may differ: the length is reported by `describe_length`, and the others matter only after training.
FREE = ("steps", "prune_share", "tune_steps", "thorough_from")


def name_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return the settings in which a checkpoint differs from a run, with both values; empty where in none.

    Args:
        before: of the checkpoint: its "config", a `TrainConfig` as a dictionary, "mapping" as text, and "aabb".
        now: the same of the run.
    """
    old, new = (
        _named(_comparable(state["config"])) | {"--space": state.get("mapping"), "--box": state["aabb"].tolist()}
        for state in (before, now)
    )
    changed = [name for name in new if old.get(name) != new[name]]
    if old["--preset"] != new["--preset"]:  # which differ in many numbers
        changed = [name for name in changed if name.startswith("--")]
    return "; ".join(f"{name} was {old.get(name)}, is {new[name]}" for name in changed)


def describe_length(steps: int, time_budget_s: float | None) -> str:
    """Return how long a run trains, as an option of kpenc.

    Args:
        steps: of the configuration, which a time budget replaces. time_budget_s: seconds, or None.
    """
    return f"--steps {steps}" if time_budget_s is None else f"--time-budget {time_budget_s:g}s"


def _named(config: dict[str, Any]) -> dict[str, Any]:
    """Return the parts of a configuration by the options of kpenc that set them, all others by their own names."""
    area = config["moving_area"]
    named = {
        "--preset": min(PRESETS, key=lambda name: len(asdict(PRESETS[name]).items() - config.items())),
        "--decoder": "hybrid" if config["hybrid"] else "explicit",
        "--sampling": "proposals" if config["proposals"] else "grid",
        "--layers": "one" if area is None else f"auto, with scales of its own for what moves in {area}",
        "--seed": config["seed"],
        "--appearance": config["appearance"],
        "--refine": config["refine"],
    }
    own = ("hybrid", "proposals", "moving_area", "seed", "appearance", "refine")
    return named | {name: value for name, value in config.items() if name not in own}


def _comparable(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration without what may differ between a run and its continuation."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in config.items() if key not in FREE}
