"""A font of the system for characters that ImGui's own font lacks, such as dashes, Greek and Cyrillic letters."""

import os
import sys
from pathlib import Path

# Fonts with many scripts, by the names and the folders that systems give them; the first one that is there is taken.
NAMES = (
    "DejaVuSans.ttf", "NotoSans-Regular.ttf", "LiberationSans-Regular.ttf",  # Linux and BSD
    "Arial Unicode.ttf", "Arial.ttf",  # macOS
    "segoeui.ttf", "arial.ttf",  # Windows
)  # fmt: skip
FOLDERS = {
    "darwin": ("/System/Library/Fonts/Supplemental", "/Library/Fonts", "/System/Library/Fonts"),
    "win32": (os.path.join(os.environ.get("WINDIR", r"C:\Windows"), "Fonts"),),
}
UNIX_FOLDERS = (
    "/usr/share/fonts/truetype/dejavu", "/usr/share/fonts/dejavu-sans-fonts", "/usr/share/fonts/dejavu",
    "/usr/share/fonts/TTF", "/usr/share/fonts/truetype/noto", "/usr/share/fonts/noto",
    "/usr/share/fonts/google-noto", "/usr/share/fonts/truetype/liberation", "/usr/share/fonts/liberation",
    "/usr/share/fonts/liberation-sans-fonts", "/usr/local/share/fonts/dejavu",
)  # fmt: skip
# A larger file is no such font.
MOST_BYTES = 64 << 20


def system_font() -> bytes | None:
    """Return the TrueType file of a font with many scripts that the system has; None if none is found."""
    for name in NAMES:
        for folder in FOLDERS.get(sys.platform, UNIX_FOLDERS):
            path = Path(folder) / name
            try:
                if path.is_file() and path.stat().st_size <= MOST_BYTES:
                    return path.read_bytes()
            except OSError:  # it cannot be read; another one may
                continue
    return None
