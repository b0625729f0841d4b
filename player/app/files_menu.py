"""The menu of files: the system's dialog, the playlist, and the files that were opened lately."""

from pathlib import PurePath

from kpc.format.common.text import valid_unicode
from kpc.format.container.http_address import is_url
from kpc.player.app.actions import Actions
from kpc.player.app.desktop import imgui
from kpc.player.app.widgets import tip

# Files of the playlist around the present one that the menu shows.
SHOWN_FILES = 12


def files_button(actions: Actions) -> None:
    """Build a button that opens the menu, and the menu while it is open."""
    playlist = actions.playlist
    if imgui.button("open"):
        imgui.open_popup("files")
    tip("Open another file (Ctrl+O, Page Up, Page Down)")
    if not imgui.begin_popup("files"):
        return
    if imgui.menu_item("choose a file...", "Ctrl+O", False)[0]:
        actions.choose_file()
    if len(playlist.files) > 1:
        imgui.separator_text("playlist")
        first = max(min(playlist.position - SHOWN_FILES // 2, len(playlist.files) - SHOWN_FILES), 0)
        for number in range(first, min(first + SHOWN_FILES, len(playlist.files))):
            _entry(actions, playlist.files[number], f"playlist{number}", number == playlist.position)
    if playlist.recent:
        imgui.separator_text("opened lately")
        for number, file in enumerate(playlist.recent):
            _entry(actions, file, f"recent{number}", False)
    imgui.end_popup()


def _entry(actions: Actions, file: str, identifier: str, is_present: bool) -> None:
    name = PurePath(file.split("?")[0] if is_url(file) else file).name
    if imgui.menu_item(f"{valid_unicode(name)}##{identifier}", "", is_present)[0] and not is_present:
        actions.open(file)
