"""Checkpoints on a disk: of a run that goes on, `kpc.encoder.training.train`, and of a finished model, `kpc.encoder.rdo.codec_model`."""

from pathlib import Path
from typing import Any

import torch
from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import TrainingError


def save_state(path: Path, state: dict[str, Any], remedy: str) -> None:
    """Write plain tensors and numbers, which are read again without unpickling code.

    Raises:
        TrainingError: it cannot be written, with the `remedy` besides free space; what was there is left as it was.
    """
    try:
        with atomic_write(path) as aside:
            torch.save(state, aside)
    except (OSError, RuntimeError) as error:  # PyTorch reports a full disk as RuntimeError
        reason = error.strerror if isinstance(error, OSError) else str(error).partition("\n")[0]
        raise TrainingError(
            f"{path}: the checkpoint cannot be written ({reason}); free space there, or {remedy}"
        ) from error
