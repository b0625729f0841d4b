"""Web pages that play scenes: a page for one, or a gallery of several, beside the player that they use.

All addresses in the pages are relative, so that the folder may lie anywhere on any static web host.
"""

import contextlib
import hashlib
import itertools
import re
import shutil
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from urllib.parse import quote, urljoin

from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import UsageError
from kpc.format.common.text import valid_unicode
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Clip

# What a page may load: what lies beside it. The player decodes by WebAssembly in workers that start from blobs.
POLICY = (
    "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; img-src 'self' data: blob:; "
    "style-src 'self' 'unsafe-inline'; connect-src 'self'$hosts"
)
PLAYER_FILES = ("kpc-player.js", "kpc-worker.js")
# How pages written by this module are recognised: only they are replaced, and the files that they record.
GENERATOR = '<meta name="generator" content="kpshare">'
RECORD = '<meta name="kpshare-files" content="$files">'
NAMED = '<meta name="kpshare-name" content="$name">'
PAGE, POSTER, STYLE = "index.html", "poster.jpg", "page.css"


@dataclass(frozen=True)
class SharedScene:
    """What a page says about a scene.

    Attributes:
        address: of the .kpc file, relative to the page, or absolute.
        name: of the file without its suffix, which stands in for a title.
        metadata: of the file.
        clip: its frames and their rate.
        size_bytes: of the file.
        has_poster: whether a poster lies beside the page.
    """

    address: str
    name: str
    metadata: Metadata
    clip: Clip
    size_bytes: int
    has_poster: bool

    @property
    def title(self) -> str:
        """The title of the scene, or the name of its file."""
        return self.metadata.title or self.name

    @property
    def facts(self) -> str:
        """Its length and size in words."""
        size = f"{self.size_bytes / 1e6:.1f} MB" if self.size_bytes >= 1e6 else f"{self.size_bytes / 1e3:.0f} KB"
        frames = self.clip.frame_count
        return f"{frames / self.clip.fps:.1f} s, {size}" if frames > 1 else f"still, {size}"

    @property
    def description(self) -> str:
        """Its description, or what can be said of every scene."""
        given = str(self.metadata.document.get("description", ""))
        return given or f"A scene to look at from all sides ({self.facts}): drag to turn, scroll to come closer."


def scene_page(
    scene: SharedScene, *, root: str = "", url: str | None = None, hosts: str = "", memory: int | None = None
) -> str:
    """Return the page of a scene.

    Args:
        scene: what it shows.
        root: where the player and the style sheet lie, relative to the page; the gallery, too, if it is not empty.
        url: where the page will be published, for link previews, which need whole addresses; None if it is not known.
        hosts: what else the page may load from, for the Content-Security-Policy.
        memory: the memory budget of the player, bytes; None for its own.
    """
    about = [f"<p>{escape(scene.description)}</p>"]
    document = scene.metadata.document
    if credit := [str(document[key]) for key in ("author", "licence", "date") if document.get(key)]:
        about.append(f"<p>{escape(', '.join(credit))}</p>")
    body = _filled(
        "scene.html",
        title=escape(scene.title),
        scene=escape(scene.address),
        poster=f' poster="{POSTER}"' if scene.has_poster else "",
        memory="" if memory is None else f' memory="{memory}"',
        about="\n".join(about),
        back=f'<p><a href="{root}{PAGE}">All scenes</a></p>' if root else "",
    )
    script = f'<script type="module" src="{root}{PLAYER_FILES[0]}"></script>'
    preview = _preview(POSTER if scene.has_poster else None, url)
    return _page(body, scene.title, scene.description, preview, root=root, hosts=hosts, script=script)


def gallery_page(scenes: Mapping[str, SharedScene], title: str, url: str | None = None) -> str:
    """Return a page that lists scenes with their posters, and with their files where several have one title.

    Args:
        scenes: by the name of the folder of each one's page.
        title: of the gallery.
        url: where the page will be published, for link previews; None if it is not known.
    """
    cards, first_poster = [], None
    for folder, scene in scenes.items():
        place = quote(folder)
        image = f'<img src="{place}/{POSTER}" alt="" loading="lazy">' if scene.has_poster else ""
        first_poster = first_poster or (f"{place}/{POSTER}" if scene.has_poster else None)
        facts = scene.facts
        alike = [name for name, one in scenes.items() if one.title == scene.title]
        if len(alike) > 1:
            files = {scenes[name].name for name in alike}
            facts = f"{scene.name if len(files) == len(alike) else folder}.kpc, {facts}"
        head = f"<h2>{escape(scene.title)}</h2><p>{escape(facts)}</p>"
        cards.append(f'<li><a href="{place}/{PAGE}">{image}{head}</a></li>')
    count = f"{len(scenes)} scene{'s' * (len(scenes) != 1)} to look at from all sides."
    body = _filled("gallery.html", title=escape(title), description=count, cards="\n".join(cards))
    return _page(body, title, count, _preview(first_poster, url))


def embed_snippet(scene: SharedScene, root: str = "", url: str | None = None) -> str:
    """Return the HTML that shows a scene within another page."""
    base = url or ""
    poster = f' poster="{escape(urljoin(base, POSTER))}"' if scene.has_poster else ""
    return (
        f'<script type="module" src="{escape(urljoin(base, root + PLAYER_FILES[0]))}"></script>\n'
        f'<kpc-player src="{escape(urljoin(base, scene.address))}"{poster} controls></kpc-player>'
    )


def player_files() -> dict[str, bytes]:
    """Return the player and the style sheet of the pages, by their names beside the pages."""
    built = files("kpc.player") / "web" / "dist"
    found = {name: (built / name).read_bytes() for name in PLAYER_FILES}
    return found | {STYLE: (files(__package__) / STYLE).read_bytes()}


def copy_player(folder: Path) -> None:
    """Put the player and the style sheet of the pages into a folder."""
    for name, content in player_files().items():
        write_file(folder / name, content)


def check_folder(folder: Path, wanted: Mapping[str, Path | bytes]) -> None:
    """Refuse a folder in which what this module did not write would be replaced.

    Args:
        folder: that is to be written.
        wanted: what is to be written beside its page, by names. Files of these names may be there already if they are
            equal, or as the page of the folder records that they were written.

    Raises:
        UsageError: a page that was changed, a page of others, or a file would be replaced.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is a file, not a folder, and stays; choose another folder with -o")
    page, text = folder / PAGE, ""
    if page.exists():
        text = _text_of(page)
        if GENERATOR not in text:
            raise UsageError(f"{page}: is not a page of kpshare and stays; choose another folder with -o")
        if not _is_unchanged(text):
            raise UsageError(f"{page}: was changed after kpshare wrote it, and stays; choose another folder with -o")
    written = _recorded(text)
    for name, content in wanted.items():
        path = folder / name
        if path.exists() and not (path.is_file() and _checksum(path) in (written.get(name), _checksum(content))):
            raise UsageError(f"{path}: is another file, and stays; choose another folder with -o")


def with_record(page: str, written: Mapping[str, Path | bytes], name: str | None = None) -> str:
    """Return a page that records itself and what was written beside it, so that only this is replaced later.

    Args:
        page: markup of a page of this module.
        written: the files, by their names, which are those of `file_name`, or such in a folder of such a name.
        name: of the scene's file without its suffix, of which a checksum is recorded; None for a gallery.
    """
    head = GENERATOR if name is None else GENERATOR + "\n" + Template(NAMED).substitute(name=_mark(name))
    listed = " ".join(f"{name}={_checksum(content)}" for name, content in written.items())

    def recording(files: str) -> str:
        return page.replace(GENERATOR, head + "\n" + Template(RECORD).substitute(files=files), 1)

    return recording(f"{listed} {PAGE}={_checksum(recording(listed).encode())}")


def _text_of(page: Path) -> str:
    """Return the text of a page with its line ends, empty if it is no file."""
    return page.read_bytes().decode(errors="replace") if page.is_file() else ""


def _is_unchanged(page: str) -> bool:
    """Return whether a page is as it was written; one of an older version, which does not record itself, counts so."""
    own = _recorded(page).get(PAGE)
    return own is None or own == _checksum(page.replace(f" {PAGE}={own}", "", 1).encode())


def own_files(folder: Path, wanted: Mapping[str, Path | bytes]) -> dict[str, Path | bytes]:
    """Return those of the files that are to be written which its page may record: they may be replaced later.

    A file of the user that lies in the folder already is not among them, unless its page records it: neither a source
    nor a copy of one.

    Args:
        folder: that is to be written, and is not yet.
        wanted: what is to be written, by names: files of the user as paths, all else as bytes.
    """
    written = _recorded(_text_of(folder / PAGE))

    def is_own(name: str, content: Path | bytes) -> bool:
        path = folder / name
        if isinstance(content, bytes) or not path.exists():
            return True
        return name in written and not path.samefile(content)

    return {name: content for name, content in wanted.items() if is_own(name, content)}


def remove_left(folder: Path, written: Collection[Path], sources: Sequence[Path]) -> list[str]:
    """Remove the files that pages of a folder record and that are not written again, such as of a scene that has left.

    Args:
        folder: that is to be written, and is not yet.
        written: all files that are to be written.
        sources: files that are read, which stay.

    Returns:
        A line for each file, or folder of a scene, that was removed, and for each file that stays.
    """
    unchanged, others = _left(folder, written, sources)
    for path in unchanged:
        path.unlink()
    removed = dict.fromkeys(unchanged)
    for place in {path.parent: None for path in unchanged if path.parent != folder}:
        with contextlib.suppress(OSError):  # other files are in it
            place.rmdir()
            removed = dict.fromkeys(place if path.parent == place else path for path in removed)
    lines = [f"{path}: is no longer shared, so removed" for path in removed]
    return lines + [f"{path}: is no longer shared; it stays, since it {why}" for path, why in others.items()]


def _left(folder: Path, written: Collection[Path], sources: Sequence[Path]) -> tuple[list[Path], dict[Path, str]]:
    """Return the files that `remove_left` may remove, and why the others stay."""
    unchanged: list[Path] = []
    others: dict[Path, str] = {}
    for name, checksum in _recorded(_text_of(folder / PAGE)).items():
        path, parts = folder / name, name.split("/")
        is_of_site = name != PAGE and len(parts) < 3 and all(part == file_name(part) for part in parts)
        if not is_of_site or path in written or not path.is_file():
            continue
        if len(parts) == 2:  # the page of a gallery's scene, which records what lies beside it, if it was changed, too
            below = _left(path.parent, written, sources)
            unchanged += below[0]
            others |= below[1]
        if any(path.samefile(source) for source in sources):
            others[path] = "is one of the scenes to share now"
        elif _checksum(path) != checksum:
            others[path] = "was changed after kpshare wrote it"
        else:
            unchanged.append(path)
    return unchanged, others


def _recorded(page: str) -> dict[str, str]:
    """Return the checksums of files by their names that a page records."""
    before, _, after = RECORD.partition("$files")
    found = re.search(f'{re.escape(before)}([^"]*){re.escape(after)}', page)
    pairs = [] if found is None else [pair.partition("=") for pair in found[1].split()]
    return {name: checksum for name, _, checksum in pairs}


def _checksum(content: Path | bytes) -> str:
    """Return the SHA-256 of a file or of bytes, in hexadecimal digits."""
    if isinstance(content, bytes):
        return hashlib.sha256(content).hexdigest()
    with content.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file of a site, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def copy_file(source: Path | bytes, target: Path) -> None:
    """Copy a file or write bytes, whole or not at all; a source that lies there already stays."""
    if isinstance(source, bytes):
        write_file(target, source)
        return
    if target.exists() and target.samefile(source):
        return
    with atomic_write(target) as temporary:
        shutil.copyfile(source, temporary)


def file_name(name: str) -> str:
    """Return a name like this one that every web host can serve: letters, digits, dots, dashes and underlines.

    A name that has to be changed ends in a part of its SHA-256, so that the address of a scene does not depend on which
    others are shared.
    """
    name = unicodedata.normalize("NFC", name)  # macOS takes letters and their accents apart
    return name if _reduced(name) == name else _marked(name)


def distinct_names(names: Sequence[str], published: Mapping[str, str] | None = None) -> list[str]:
    """Return names for files or folders of a site, none of which differs from another by capitals alone.

    None is that of a file that lies beside them. Each follows from its own name, but where names differ by capitals
    alone: one of them is marked as `file_name` does, rather not one that is published, nor one without capitals.

    Args:
        names: without suffixes.
        published: names that some of them had until now (`published_names`), which they keep.
    """
    published = {} if published is None else published
    taken = {PAGE, POSTER, STYLE, *PLAYER_FILES}
    found = [""] * len(names)
    order = sorted(range(len(names)), key=lambda k: (names[k] not in published, names[k] != names[k].lower()))
    for number in order:
        name = names[number]
        wanted = [published[name]] if name in published else []
        wanted += [file_name(name), _marked(name)]
        others = (f"{wanted[-1]}-{count}" for count in itertools.count(2))  # for files of one name in several folders
        found[number] = next(one for one in itertools.chain(wanted, others) if one.lower() not in taken)
        taken.add(found[number].lower())
    return found


def published_names(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the names of the site in a folder under which scenes are published there, by the names of their files.

    Pages record of which file they are; those of versions that did not are taken to be of the only one of `names` that
    their own may stand for.
    """
    found: dict[str, str] = {}
    for recorded in _recorded(_text_of(folder / PAGE)):
        address, _, rest = recorded.partition("/")
        if not rest and address.endswith(".kpc"):  # beside the page of a single scene
            address, page = address.removesuffix(".kpc"), PAGE
        elif rest == PAGE:
            page = recorded
        else:
            continue
        if address != file_name(address):
            continue
        before, _, after = NAMED.partition("$name")
        mark = re.search(f'{re.escape(before)}([^"]*){re.escape(after)}', _text_of(folder / page))
        of = [
            name
            for name in dict.fromkeys(names)
            if (_reduced(name) == address if mark is None else _mark(name) == mark[1])
        ]
        if len(of) == 1:
            found.setdefault(of[0], address)
    return found


def _reduced(name: str) -> str:
    """Return a name without what a web host may not serve."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", unicodedata.normalize("NFC", name)).strip("-.") or "scene"


def _marked(name: str) -> str:
    return f"{_reduced(name)}-{_mark(name)}"


def _mark(name: str) -> str:
    """Return a part of the SHA-256 of a name, by which it is distinguished from others."""
    return _checksum(unicodedata.normalize("NFC", name).encode(errors="surrogateescape"))[:8]


def _preview(poster: str | None, url: str | None) -> str:
    """Return the elements of a link preview that need whole addresses, or relative ones where none is known."""
    lines = []
    if url is not None:
        lines += [f'<link rel="canonical" href="{escape(url)}">', f'<meta property="og:url" content="{escape(url)}">']
    if poster is not None:
        lines.append(f'<meta property="og:image" content="{escape(urljoin(url or "", poster))}">')
        lines.append('<meta name="twitter:card" content="summary_large_image">')
    return "\n".join(lines)


def _page(
    body: str, title: str, description: str, preview: str, *, root: str = "", hosts: str = "", script: str = ""
) -> str:
    """Return a whole page around a body, which is markup, as are preview and script; title and description are not."""
    return _filled(
        "page.html",
        policy=Template(POLICY).substitute(hosts=escape(hosts)),
        title=escape(title),
        description=escape(description),
        preview=preview,
        root=root,
        script=script,
        body=body,
    )


def _filled(template: str, **values: str) -> str:
    return valid_unicode(Template((files(__package__) / template).read_text()).substitute(values))
