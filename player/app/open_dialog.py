"""The system's dialog to choose a file: a program that runs beside the window."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable

from kpc.format.common.errors import DisplayError

TITLE, SCENES, PATTERNS = "Open a scene", "scenes and camera paths", ("*.kpc", "*.json")
# Windows' own dialog and that of macOS, in the languages that each system runs.
POWERSHELL = f"""
Add-Type -AssemblyName System.Windows.Forms
[Console]::OutputEncoding = [Text.Encoding]::UTF8
$dialog = New-Object System.Windows.Forms.OpenFileDialog
$dialog.Title = '{TITLE}'
$dialog.Filter = '{SCENES}|{";".join(PATTERNS)}|all files|*.*'
$dialog.InitialDirectory = $env:KPC_FOLDER
if ($dialog.ShowDialog() -eq 'OK') {{ $dialog.FileName }}
"""
APPLESCRIPT = (
    "on run argv",
    f'POSIX path of (choose file with prompt "{TITLE}" default location (POSIX file (item 1 of argv)))',
    "end run",
)


def _zenity(program: str, folder: str) -> list[str]:
    scenes = f"--file-filter={SCENES} | {' '.join(PATTERNS)}"
    return [
        *(program, "--file-selection", f"--title={TITLE}"),
        *(f"--filename={os.path.join(folder, '')}", scenes, "--file-filter=all files | *"),
    ]


def _kdialog(program: str, folder: str) -> list[str]:
    filters = f"{SCENES} ({' '.join(PATTERNS)})\nall files (*)"
    return [program, "--title", TITLE, "--getopenfilename", folder, filters]


# Programs that show dialogs on Linux, and their commands.
PROGRAMS: dict[str, Callable[[str, str], list[str]]] = {
    "zenity": _zenity,
    "kdialog": _kdialog,
    "matedialog": _zenity,
    "qarma": _zenity,
}


def dialog_command(platform: str, folder: str) -> list[str]:
    """Return the command that shows the dialog and prints the path of the file that is chosen.

    Args:
        platform: `sys.platform`.
        folder: where the dialog begins.

    Raises:
        DisplayError: nothing on this system shows dialogs.
    """
    if platform == "win32":
        return ["powershell", "-NoProfile", "-STA", "-Command", POWERSHELL]
    if platform == "darwin":
        return ["osascript", *(word for line in APPLESCRIPT for word in ("-e", line)), folder]
    for name, command in PROGRAMS.items():
        if (program := shutil.which(name)) is not None:
            return command(program, folder)
    raise DisplayError("no program that shows dialogs was found; install zenity or kdialog, or drop a file here")


class OpenDialog:
    """A dialog that may be open. It never makes the window wait."""

    def __init__(self) -> None:
        self._dialog: subprocess.Popen[bytes] | None = None

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
        if self.is_open:
            return
        try:
            self._dialog = subprocess.Popen(
                dialog_command(sys.platform, folder),
                env={**os.environ, "KPC_FOLDER": folder},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            raise DisplayError(f"no dialog can be shown ({error.strerror}); drop a file here") from error

    def take_chosen(self) -> str | None:
        """Return the file that was chosen since the last call; None if there is none, or if the dialog was left."""
        if self._dialog is None or self._dialog.poll() is None:
            return None
        printed, _ = self._dialog.communicate()
        self._dialog = None
        return os.fsdecode(printed).rstrip("\r\n") or None
