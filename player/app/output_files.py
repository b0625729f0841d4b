"""Names for the files that a player writes: screenshots, videos, camera paths."""

import re
from pathlib import Path


class OutputFiles:
    """Free file names in a folder.

    Args:
        folder: where the files go.
        source_name: file name or address of the scene; its stem, without characters that some systems refuse, begins
            all names.
    """

    def __init__(self, folder: Path, source_name: str) -> None:
        self.folder = folder
        self.stem = re.sub(r"[^\w.+-]", "_", Path(source_name).stem)[:80] or "scene"

    def next_path(self, suffix: str) -> Path:
        """Return the first absolute path that does not exist of stem-001<suffix>, stem-002<suffix> and so on."""
        paths = (self.folder / f"{self.stem}-{number:03d}{suffix}" for number in range(1, 1_000_000))
        return next(path for path in paths if not path.exists()).absolute()
