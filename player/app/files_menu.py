"""The menu of files: the system's dialog, the playlist, and the files that were opened lately."""

from kpc.format.common.text import escaped, valid_unicode
from kpc.format.container.http_address import is_url, public_name
from kpc.player.app.actions import Actions
from kpc.player.app.desktop import imgui
from kpc.player.app.playlist import menu_names
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
        shown = playlist.files[first : first + SHOWN_FILES]
        for number, (file, name) in enumerate(zip(shown, menu_names(shown), strict=True), first):
            _entry(actions, file, name, f"playlist{number}", number == playlist.position)
    if playlist.recent:
        imgui.separator_text("opened lately")
        for number, (file, name) in enumerate(zip(playlist.recent, menu_names(playlist.recent), strict=True)):
            _entry(actions, file, name, f"recent{number}", False)
    imgui.end_popup()


def _entry(actions: Actions, file: str, name: str, identifier: str, is_present: bool) -> None:
    label = name.replace("##", "# #")  # ImGui shows no more than what is before "##"
    if imgui.menu_item(f"{label}##{identifier}", "", is_present)[0] and not is_present:
        actions.open(file)
    tip(escaped(valid_unicode(public_name(file) if is_url(file) else file)))
