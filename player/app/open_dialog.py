"""The system's dialog to choose a file, which runs beside the window."""

import shutil
import sys
from typing import Any

from kpc.format.common.errors import DisplayError
from kpc.player.app.desktop import portable_file_dialogs

# Programs that show dialogs on Linux; other systems have their own.
PROGRAMS = ("zenity", "kdialog", "matedialog", "qarma")
FILTERS = ["scenes and camera paths", "*.kpc *.json", "all files", "*"]


class OpenDialog:
    """A dialog that may be open. It never makes the window wait."""

    def __init__(self) -> None:
        self._dialog: Any = None

    @property
    def is_open(self) -> bool:
        """Whether the dialog is shown."""
        return self._dialog is not None

    def show(self, folder: str) -> None:
        """Show the dialog, unless it is shown.

        Args:
            folder: where it begins.

        Raises:
            DisplayError: nothing on this system shows dialogs.
        """
        if sys.platform == "linux" and not any(map(shutil.which, PROGRAMS)):
            raise DisplayError(
                "no program that shows dialogs was found; install zenity or kdialog, or drop a file here"
            )
        if not self.is_open:
            self._dialog = portable_file_dialogs.open_file("Open a scene", folder, FILTERS)

    def take_chosen(self) -> str | None:
        """Return the file that was chosen since the last call; None if there is none, or if the dialog was left."""
        if self._dialog is None or not self._dialog.ready(0):
            return None
        chosen, self._dialog = self._dialog.result(), None
        return str(chosen[0]) if chosen else None
