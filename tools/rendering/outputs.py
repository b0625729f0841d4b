"""What the name of kprender's output stands for: a film, a picture, or a folder of pictures."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kpc.format.common.errors import UsageError
from kpc.format.common.films import DEFAULT_CODECS
from kpc.format.common.media_files import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from kpc.tools.cli.depth_images import depth_path

FILM_SUFFIXES = tuple(DEFAULT_CODECS)
PICTURE_FORMATS = ("png", "jpg", "exr")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")


@dataclass(frozen=True)
class Output:
    """Where pictures go.

    Attributes:
        path: of the file or folder.
        suffix: of the film or of every picture, in small letters, with its dot.
        is_film, is_folder: what it is; a single picture is neither.
    """

    path: Path
    suffix: str
    is_film: bool = False
    is_folder: bool = False

    @staticmethod
    def of(text: str, picture_format: str | None) -> "Output":
        """Return the output that a name and --format ask for.

        A name without suffix, with a slash at its end, or of a folder that exists is a folder.

        Args:
            text: the name.
            picture_format: one of PICTURE_FORMATS; None if it was not asked for.

        Raises:
            UsageError: nothing of that kind can be written, or name and format contradict each other.
        """
        path, suffix = Path(text), Path(text).suffix.lower()
        if path.name == "-" or path.name.endswith(".") or path.name.lower() in FILM_SUFFIXES + PICTURE_SUFFIXES:
            raise UsageError(f"-o {text}: is no name of a file or folder; give one such as clip.mp4 or still.png")
        has_slash = text.endswith(tuple(filter(None, (os.sep, os.altsep))))
        if not suffix or has_slash or (path.is_dir() and not _is_of_media(text)):
            return Output(path, f".{picture_format or PICTURE_FORMATS[0]}", is_folder=True)
        if suffix not in FILM_SUFFIXES + PICTURE_SUFFIXES:
            raise UsageError(
                f"-o {text}: {path.suffix} is not written; give a film ({', '.join(FILM_SUFFIXES)}), a picture "
                f"({', '.join(PICTURE_SUFFIXES)}), or a folder: a name without suffix or with / at its end"
            )
        if picture_format is not None and suffix.replace("jpeg", "jpg") != f".{picture_format}":
            raise UsageError(
                f"-o {text}: --format {picture_format} contradicts {suffix}; leave --format out, or give a folder or a "
                f".{picture_format}"
            )
        if path.is_dir():
            raise UsageError(f"-o {text}: is a folder; give another name, or {text}/ for pictures in it")
        return Output(path, suffix, is_film=suffix in FILM_SUFFIXES)

    def picture_paths(self, names: Sequence[str], with_depth: bool) -> tuple[list[Path], list[tuple[str, str]]]:
        """Return the path of each picture, and the new names of those that could not keep theirs.

        Camera files may come from anywhere: only the last part of their names is used, or all of them joined where that
        part is there twice. No picture has the name of another's depth.

        Args:
            names: of the pictures, as the camera file lists them.
            with_depth: whether the depth of each picture goes beside it.
        """
        if not self.is_folder:
            return [self.path], []
        bare = [re.split(r"[/\\]", _without_suffix(name))[-1] for name in names]
        repeated = {stem for stem, count in Counter(map(plain_name, bare)).items() if count > 1}
        paths, used, renamed = [], set[str](), list[tuple[str, str]]()
        for number, name in enumerate(names):
            stem = plain_name(bare[number])
            if stem in repeated:  # none keeps it, else the pictures of one folder would pass for those of another
                stem = plain_name(_without_suffix(name))
            stem = stem or f"{number:04d}"
            while used & (taken := self._stems(stem, with_depth)):
                stem = f"{stem}_{number:04d}"
            used |= taken
            paths.append(self.path / f"{stem}{self.suffix}")
            if stem != bare[number]:
                renamed.append((name, paths[-1].name))
        return paths, renamed

    def _stems(self, stem: str, with_depth: bool) -> set[str]:
        """Return the names without suffix of a picture and, if it is wanted, its depth."""
        return {stem, depth_path(Path(f"{stem}{self.suffix}")).stem} if with_depth else {stem}


def _without_suffix(name: str) -> str:
    return name.rsplit(".", 1)[0] if _is_of_media(name) else name


def plain_name(name: str, most: int = 120) -> str:
    """Return a name of at most so many letters, digits, spaces and some signs, which is no path and not hidden."""
    return re.sub(r"[^\w.+ -]", "_", name)[-most:].lstrip(". ")


def _is_of_media(name: str) -> bool:
    """Return whether a name ends in the suffix of a picture or film; another ending is part of the name."""
    return Path(name).suffix.lower() in IMAGE_SUFFIXES + VIDEO_SUFFIXES
