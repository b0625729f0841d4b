"""Writing of checkpoints: of a run in progress (`train`) and of a finished model (`kpc.encoder.rdo.codec_model`)."""

from pathlib import Path
from typing import Any

import torch

from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import TrainingError


def save_state(path: Path, state: dict[str, Any], remedy: str) -> None:
    """Write plain tensors and numbers, which can be read without unpickling code.

    Raises:
        TrainingError: the file cannot be written; `remedy` is what the message suggests besides freeing space. A file
            that was there is left unchanged.
    """
    try:
        with atomic_write(path) as aside:
            torch.save(state, aside)
    except (OSError, RuntimeError) as error:  # PyTorch reports a full disk as RuntimeError
        reason = error.strerror if isinstance(error, OSError) else str(error).partition("\n")[0]
        raise TrainingError(
            f"{path}: the checkpoint cannot be written ({reason}); free space there, or {remedy}"
        ) from error
