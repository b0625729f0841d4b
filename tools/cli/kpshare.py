"""kpshare: make a folder for any web host, with pages that play scenes.

    kpshare scene.kpc -o site/                          a page that plays the scene
    kpshare scene.kpc -o site/ --url https://host/a/    link previews and the snippet have whole addresses
    kpshare one.kpc two.kpc -o site/                    a gallery, and a page for each scene
    kpshare --gallery scenes/ -o site/                  the same, of all scenes of a folder

Nothing needs to run on the host, and nothing is loaded from elsewhere. `kpplay --web scene.kpc` shows a scene in a
browser on this machine.
"""

import argparse
import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import urljoin

import kpc
from kpc.format.common import cli
from kpc.format.common.errors import KpcError, NetworkError, UsageError
from kpc.format.common.images import write_image
from kpc.format.common.progress import progress
from kpc.format.common.text import counted, escaped, notice
from kpc.format.container.groups import Groups, check_checksums
from kpc.format.container.http_address import Address, public_name
from kpc.player.app.playlist import Playlist
from kpc.player.sharing import site
from kpc.player.sharing.site import SharedScene
from kpc.tools.rendering.claims import claimed
from kpc.tools.rendering.poster import render_poster

# The quality of posters as JPEG: they are seen for a second, and are to be no larger than scenes.
POSTER_QUALITY = 80


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpshare", argv)


def _command(argv: list[str]) -> None:
    options = _parser().parse_args(argv)
    named = Playlist.named([str(path) for path in _inputs(options)]).files
    files = list({os.path.abspath(name): Path(name) for name in named}.values())  # each once, though named twice
    is_gallery = options.gallery is not None or len(files) > 1
    folder = options.output
    cli.check_writable(folder, is_folder=True)
    stems = [file.stem for file in files]
    names = site.distinct_names(stems, site.published_names(folder, stems))
    folders = [folder / name if is_gallery else folder for name in names]
    player = site.player_files()
    at_page = {} if is_gallery else player  # those of a gallery lie above its pages
    beside: list[dict[str, Path | bytes]] = [{f"{name}.kpc": file} for file, name in zip(files, names, strict=True)]

    def check() -> None:
        if is_gallery:
            site.check_folder(folder, player)
        for place, wanted in zip(folders, beside, strict=True):
            site.check_folder(place, {**at_page, **wanted})

    check()
    _check_scenes(files)
    root = "../" if is_gallery else ""
    with _held(folder, files, options), tempfile.TemporaryDirectory() as aside:
        # Nothing is written into the folder if one of the scenes cannot be read, or a poster would replace another.
        posters = [Path(aside) / f"{name}.jpg" for name in names]
        inputs = progress(list(zip(files, names, posters, strict=True)), "kpshare", unit="scenes")
        scenes = {name: _read(file, name, poster) for file, name, poster in inputs}
        for wanted, poster in zip(beside, posters, strict=True):
            wanted[site.POSTER] = poster.read_bytes()
        check()  # again, with the posters
        written = {folder / name for name in (*player, site.PAGE)}
        for place, wanted in zip(folders, beside, strict=True):
            written |= {place / name for name in (*wanted, site.PAGE)}
        for line in site.remove_left(folder, written, files):
            notice(f"kpshare: {line}")
        site.copy_player(folder)
        pages: dict[str, Path | bytes] = {}
        for (name, scene), place, wanted in zip(scenes.items(), folders, beside, strict=True):
            place.mkdir(exist_ok=True)
            own = site.own_files(place, {**at_page, **wanted})
            for beside_name, source in wanted.items():
                site.copy_file(source, place / beside_name)
            url = None if options.url is None else urljoin(options.url, f"{name}/" if is_gallery else "")
            page = site.scene_page(scene, root=root, url=url)
            site.write_file(place / site.PAGE, site.with_record(page, own, scene.name))
            pages[f"{name}/{site.PAGE}"] = place / site.PAGE
        if is_gallery:
            title = options.title or (options.gallery or folder).absolute().name
            page = site.gallery_page(scenes, title, options.url)
            site.write_file(folder / site.PAGE, site.with_record(page, {**player, **pages}))
    size = sum(file.stat().st_size for file in written)
    what = f"{counted(len(files), 'scene')}, {size:,} bytes"
    print(escaped(f"{folder / site.PAGE}: {what}; put {folder} on a web host"))
    if not is_gallery:
        print("\nTo show it within another page:\n" + site.embed_snippet(scenes[names[0]], url=options.url))


@contextlib.contextmanager
def _held(folder: Path, files: Sequence[Path], options: argparse.Namespace) -> Iterator[None]:
    """Make a folder and keep runs with other options out of it; remove what was made if it stays empty."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    sources = [[str(file.absolute()), file.stat().st_size, file.stat().st_mtime_ns] for file in files]
    cli.make_folder(folder)
    try:
        with claimed(folder, "kpshare", {"sources": sources, "title": options.title, "url": options.url}):
            yield
    finally:
        with contextlib.suppress(OSError):  # there are files in it
            for path in made:
                path.rmdir()


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(prog="kpshare", description="Make a folder for any web host, with pages that play scenes.")
    cli.add_version_option(parser)
    parser.add_argument(
        "scenes", nargs="*", type=cli.input_path, metavar="scene", help=".kpc files, or folders of them"
    )
    parser.add_argument(
        "-o", "--output", type=cli.output_path, required=True, metavar="DIR", help="the folder to write; it is made"
    )
    parser.add_argument(
        "--gallery", type=cli.input_path, metavar="DIR", help="a page that lists all scenes of this folder"
    )
    parser.add_argument("--title", metavar="TEXT", help="title of the gallery (default: the name of the folder)")
    parser.add_argument(
        "--url", type=_url, metavar="URL", help="where the folder will be published, for link previews of social media"
    )
    return parser


def _inputs(options: argparse.Namespace) -> list[Path]:
    if options.gallery is not None and not options.gallery.is_dir():
        raise UsageError(f"--gallery {options.gallery}: no such folder")
    inputs = [*options.scenes, *([] if options.gallery is None else [options.gallery])]
    if not inputs:
        raise UsageError("no scene is given; name a .kpc file, or a folder of them with --gallery")
    if options.title is not None and options.gallery is None and len(inputs) == 1 and not inputs[0].is_dir():
        raise UsageError("--title: a page of one scene has the scene's own title, which kpedit --title sets")
    return inputs


def _check_scenes(files: Sequence[Path]) -> None:
    """Check all scenes by their checksums, which takes less than a poster of one; print what is wrong with each.

    Raises:
        KpcError, OSError: what is wrong with the last one that cannot be shared.
    """
    faults: list[KpcError | OSError] = []
    for file in progress(files, "checking", unit="scenes"):
        try:
            groups = Groups(file)
            groups.metadata()
            check_checksums(groups)
        except (KpcError, OSError) as error:
            if cli.message_of(error) is None:
                raise
            faults.append(error)
    for fault in faults[:-1]:
        cli.print_error("kpshare", cli.message_of(fault) or "")
    if faults:
        raise faults[-1]


def _read(file: Path, name: str, poster: Path) -> SharedScene:
    """Read a scene, write its poster, and return what its page is to say."""
    loaded = kpc.load(file)
    scene, _ = loaded.at(0.0)
    write_image(poster, render_poster(loaded), POSTER_QUALITY)
    return SharedScene(f"{name}.kpc", file.stem, scene.metadata, loaded.clip, file.stat().st_size, has_poster=True)


def _url(text: str) -> str:
    """Parse the address of a folder of a web host; return it as browsers request it, with a slash at its end."""
    try:
        address = Address.parse(text)
    except NetworkError:
        shown = public_name(text)
        raise argparse.ArgumentTypeError(
            f"{shown!r} is no address of a web page, such as https://example.org/scene/"
        ) from None
    if address.authorization is not None:
        raise argparse.ArgumentTypeError("user and password would be published; leave them out")
    if "?" in text or "#" in text:
        raise argparse.ArgumentTypeError(f"{address.name!r} is followed by ? or #, which no folder has; leave them out")
    return address.url if address.url.endswith("/") else address.url + "/"


if __name__ == "__main__":
    sys.exit(main())
