"""Playing scenes in the browser of this machine."""

import tempfile
import threading
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar
from urllib.parse import urlsplit

from kpc.format.common.cli import message_of
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.common.memory import DEFAULT_BUDGET
from kpc.format.common.text import notice
from kpc.format.container.groups import Groups
from kpc.format.container.http_address import is_url
from kpc.player.sharing import site
from kpc.player.sharing.file_server import Handler, serving
from kpc.player.sharing.site import SharedScene

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


class _Handler(Handler):
    """Serves a folder and, by other names, files that lie elsewhere; to pages of its own alone."""

    is_shared = False
    elsewhere: ClassVar[Mapping[str, Path]] = {}

    def answer_request(self, answer_folder: "Callable[[], None]") -> None:
        """Answer a request that names this machine: a page whose name was made to lead here could read the files."""
        host = self.headers.get("Host", "").lower().rpartition(":")[0]  # a tunnel may have another port
        if host in ("localhost", "127.0.0.1", "[::1]"):
            super().answer_request(answer_folder)
        else:
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST, explain="Only localhost, with its port, is answered.")

    def translate_path(self, path: str) -> str:
        """Return the file that a request means."""
        found = self.elsewhere.get(urlsplit(path).path)
        return super().translate_path(path) if found is None else str(found)


def play_in_browser(files: Sequence[str], memory: int | None = None) -> None:
    """Serve a page that plays scenes, open it in the browser, and go on serving until Ctrl-C.

    Args:
        files: paths and addresses of .kpc files; several are listed by a gallery, without those that cannot be read,
            for each of which a line is printed. Of a file that is cut off, what is there is played.
        memory: the memory budget of the player, bytes; None for its own.

    Raises:
        OSError, FormatError, NetworkError, BudgetError: no file can be read.
        UsageError: an address has a user and password.
    """
    with serving_pages(files, memory) as url:
        is_open = webbrowser.open(url)
        print(f"{url} {'is open in' if is_open else 'opens in'} a browser; Ctrl-C ends the server", flush=True)
        threading.Event().wait()


@contextmanager
def serving_pages(files: Sequence[str], memory: int | None = None) -> "Iterator[str]":
    """Serve pages that play scenes to this machine while the context lasts; the arguments are `play_in_browser`'s.

    Yields:
        The URL of the first page.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kpplay-")))
        elsewhere = _write_pages(files, folder, memory)
        handler = type("_Pages", (_Handler,), {"elsewhere": elsewhere})
        yield stack.enter_context(serving(folder, handler=handler)) + "/"


def _opened(files: Sequence[str], budget: int) -> list[tuple[str, Groups]]:
    """Open the files that can be read, and print a line about each that cannot, or whose end is missing.

    Raises:
        KpcError, OSError: none can be read; why the last one cannot.
    """
    found: list[tuple[str, Groups]] = []
    for number, file in enumerate(files):
        try:
            groups = Groups(file, memory_budget=budget, allow_partial=True)
            groups.metadata()
        except (KpcError, OSError) as error:
            if not found and number + 1 == len(files):
                raise
            notice(f"kpplay: {message_of(error) or error}; left out")
            continue
        found.append((file, groups))
        if groups.reader.cut_off is not None:
            notice(f"kpplay: {groups.reader.cut_off}; what is there is played")
    return found


def _write_pages(files: Sequence[str], folder: Path, memory: int | None) -> dict[str, Path]:
    """Write a page for each scene and, for several, a gallery; return where the files are that the pages name."""
    if any(is_url(file) and "@" in urlsplit(file).netloc for file in files):
        raise UsageError("--web: browsers take no user and password in the address of a file; play it without --web")
    opened = _opened(files, DEFAULT_BUDGET if memory is None else memory)
    files = [file for file, _ in opened]
    site.copy_player(folder)
    elsewhere: dict[str, Path] = {}
    stems = [Path(urlsplit(file).path if is_url(file) else file).stem for file in files]
    is_gallery = len(files) > 1
    scenes = {}
    for (file, groups), stem, name in zip(opened, stems, site.distinct_names(stems), strict=True):
        prefix = f"{name}/" if is_gallery else ""
        address, hosts = f"{name}.kpc", ""
        if is_url(file):
            address, hosts = file, f" {urlsplit(file).scheme}://{urlsplit(file).netloc}"
        else:
            elsewhere[f"/{prefix}{address}"] = Path(file).absolute()
        length = groups.reader.header.file_length
        size = length if groups.reader.source.size is None else min(length, groups.reader.source.size)
        scene = SharedScene(address, stem, groups.metadata(), groups.clip, size, has_poster=False)
        (folder / prefix).mkdir(exist_ok=True)
        page = site.scene_page(scene, root="../" if is_gallery else "", hosts=hosts, memory=memory)
        site.write_file(folder / prefix / site.PAGE, page)
        scenes[name] = scene
    if is_gallery:
        site.write_file(folder / site.PAGE, site.gallery_page(scenes, "kpplay"))
    return elsewhere
