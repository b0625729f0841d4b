"""The files that a player goes through, and those that were opened lately. No window."""

from collections.abc import Sequence
from pathlib import Path

from kpc.format.common.errors import UsageError

# Files that are remembered as opened lately.
MAX_RECENT = 8


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

        Raises:
            UsageError: a folder has no .kpc files.
            OSError: a folder cannot be read.
        """
        files: list[str] = []
        for argument in arguments:
            if not Path(argument).is_dir():
                files.append(argument)
                continue
            found = sorted(str(path) for path in Path(argument).iterdir() if path.suffix.lower() == ".kpc")
            if not found:
                raise UsageError(f"{argument}: this folder has no .kpc files; name a file, or another folder")
            files += found
        return Playlist(files, recent)

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
        if self.files[self.position] != file:
            if file not in self.files:
                self.files.insert(self.position + 1, file)
            self.position = self.files.index(file)
        self.recent = (public_name, *(name for name in self.recent if name != public_name))[:MAX_RECENT]
