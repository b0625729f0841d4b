"""The files that a player goes through, and those that were opened lately. No window."""

import os
from collections.abc import Sequence
from pathlib import Path, PurePath

from kpc.format.common.errors import UsageError
from kpc.format.common.text import escaped, valid_unicode
from kpc.format.container.http_address import is_url, public_name

# Files that are remembered as opened lately.
MAX_RECENT = 8
# Characters of a file's name in a menu, so that it fits the smallest window.
NAME_CHARACTERS = 56


class Playlist:
    """Files in the order in which they are played.

    Args:
        files: paths and addresses; at least one.
        recent: files that were opened before, the latest first.

    Attributes:
        files: as given, and those that were opened since.
        position: of the present file in `files`.
        recent: the files that were opened last, the latest first.
    """

    def __init__(self, files: Sequence[str], recent: Sequence[str] = ()) -> None:
        self.files, self.position, self.recent = list(files), 0, tuple(recent)

    @staticmethod
    def named(arguments: Sequence[str], recent: Sequence[str] = ()) -> "Playlist":
        """Return the playlist of arguments of the command line; a folder stands for its .kpc files in order of names.

        Folders that have such names do not count, nor do hidden files, such as macOS leaves beside others.

        Raises:
            UsageError: a folder has no .kpc files.
            OSError: a folder cannot be read.
        """
        return Playlist(_files_of(arguments), recent)

    def add(self, arguments: Sequence[str]) -> list[str]:
        """Put files after the present one, unless they are in the playlist, and return them.

        Args:
            arguments: paths, of which a folder stands for files as for `named`.

        Raises:
            UsageError, OSError: as for `named`.
        """
        files = _files_of(arguments)
        new = [file for file in files if self._position_of(file) is None]
        self.files[self.position + 1 : self.position + 1] = new
        return files

    def step(self, count: int) -> str:
        """Go `count` files forward, round the ends, and return the file there."""
        self.position = (self.position + count) % len(self.files)
        return self.files[self.position]

    def opened(self, file: str, public_name: str) -> None:
        """Make a file the present one, after that before it if it is new, and the latest of the recent ones.

        Args:
            file: its path or address.
            public_name: its absolute path, or its address without what is secret.
        """
        if _identity(self.files[self.position]) != _identity(file):
            self.add([file])
            self.position = self._position_of(file) or 0
        self.recent = (public_name, *(name for name in self.recent if name != public_name))[:MAX_RECENT]

    def _position_of(self, file: str) -> int | None:
        identities = [_identity(one) for one in self.files]
        return identities.index(_identity(file)) if _identity(file) in identities else None


def _files_of(arguments: Sequence[str]) -> list[str]:
    files: list[str] = []
    for argument in arguments:
        if is_url(argument) or not Path(argument).is_dir():
            files.append(argument)
            continue
        found = sorted(
            str(path)
            for path in Path(argument).iterdir()
            if path.suffix.lower() == ".kpc" and not path.name.startswith(".") and not path.is_dir()
        )
        if not found:
            raise UsageError(f"{argument}: this folder has no .kpc files; name a file, or another folder")
        files += found
    return files


def _identity(file: str) -> str:
    """Return what is the same for all names of a file: it may be given by a relative path and an absolute one."""
    return file if is_url(file) else os.path.abspath(file)


def menu_names(files: Sequence[str]) -> list[str]:
    """Return short names that tell files apart: their own, with that of the folder where another is called alike.

    Long names lose their middle, since takes differ at the end.

    Args:
        files: paths and addresses.
    """
    paths = [PurePath(public_name(file) if is_url(file) else file) for file in files]
    # By the paths, since a file may be there twice.
    alike = {path.name for path in paths if any(one.name == path.name and one != path for one in paths)}
    names = [f"{path.parent.name}/{path.name}" if path.name in alike else path.name for path in paths]
    return [_shortened(escaped(valid_unicode(name))) for name in names]


def _shortened(name: str) -> str:
    head = NAME_CHARACTERS // 2
    return name if len(name) <= NAME_CHARACTERS else f"{name[:head]}...{name[head + 3 - NAME_CHARACTERS :]}"
