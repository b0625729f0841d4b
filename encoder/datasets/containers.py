"""Opening video files with PyAV."""

import os
from pathlib import Path
from typing import Any

import av
from av.container import InputContainer

# PyAV before version 19 fails on names that are not UTF-8 unless it is to replace what cannot be decoded; later ones
# always do something like it, and no longer take the argument.
_METADATA: dict[str, Any] = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}


def open_container(path: str | os.PathLike[str], **options: str) -> InputContainer:
    """Open a file with libav, which may read that file alone, whatever it refers to.

    Args:
        path: of the file.
        options: of libav's demuxer.

    Raises:
        av.FFmpegError: libav cannot read it.
    """
    options = {"protocol_whitelist": "file", **options}
    return av.open(f"file:{Path(path).absolute()}", mode="r", options=options, **_METADATA)
