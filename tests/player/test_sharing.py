"""Pages that play scenes: those of kpshare, and those of kpplay --web."""

import hashlib
import re
import shutil
import urllib.error
import urllib.request
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from kpc.format.common.errors import FormatError
from kpc.format.container import groups
from kpc.format.container.rewriting import with_metadata
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import Clip
from kpc.player.app import kpplay
from kpc.player.sharing import site
from kpc.player.sharing.site import SharedScene
from kpc.player.sharing.web_view import serving_pages
from kpc.tools.cli import kpshare
from kpc.tools.rendering.claims import claimed

SAMPLE = Path(__file__).parent.parent.parent / "samples" / "default.kpc"
HOSTILE = '"><script>alert(1)</script>&'


class Page(HTMLParser):
    """The elements and addresses of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def addresses(self) -> list[str]:
        found = [value for _, name, value in self.attributes if name in ("src", "href", "poster")]
        return [address for address in found if not address.startswith("data:")]

    def content(self, name: str) -> str:
        """Return what a `meta` element of this name says."""
        place = next(i for i, (_, _, value) in enumerate(self.attributes) if value == name)
        return next(value for _, key, value in self.attributes[place:] if key == "content")


def shared(**members: str) -> SharedScene:
    return SharedScene("scene.kpc", "scene", Metadata(members), Clip(30, 12.0), 57_243, has_poster=True)


@pytest.fixture
def quick_posters(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make posters small: how they are rendered is tested by itself."""
    monkeypatch.setattr("kpc.tools.rendering.poster.SIDE", 16)
    monkeypatch.setattr("kpc.tools.rendering.poster.SLOW_SIDE", 16)


def test_a_page_says_what_the_file_says() -> None:
    page = Page(site.scene_page(shared(title="A vase", description="It stands.", author="A", licence="CC0")))
    assert page.content("og:title") == "A vase" and page.content("description") == "It stands."
    assert ("kpc-player", "src", "scene.kpc") in page.attributes
    assert page.content("og:image") == "poster.jpg"
    assert "57 KB" in Page(site.scene_page(shared())).content("description")


def test_texts_of_a_file_are_never_markup() -> None:
    hostile = shared(title=HOSTILE, description=HOSTILE, author=HOSTILE, licence="${title}")
    plain, attacked = Page(site.scene_page(shared(author="A"))), Page(site.scene_page(hostile))
    assert attacked.tags == plain.tags and attacked.content("og:title") == HOSTILE
    assert Page(site.gallery_page({"a": hostile}, HOSTILE)).tags == Page(site.gallery_page({"a": shared()}, "g")).tags


def test_a_name_that_is_no_unicode_is_shown_with_its_letters_replaced() -> None:
    page = site.scene_page(replace(shared(), name="caf\udce9"))
    assert "<title>caf\ufffd</title>" in page and page.encode()


def test_a_published_address_makes_link_previews_whole() -> None:
    page = Page(site.scene_page(shared(), url="https://host.example/a/"))
    assert page.content("og:image") == "https://host.example/a/poster.jpg"
    snippet = site.embed_snippet(shared(), url="https://host.example/a/")
    assert 'src="https://host.example/a/kpc-player.js"' in snippet


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        (["A", "a", "b"], ["A-559aead0", "a", "b"]),
        (["zwei Köpfe", "..", "con/../x"], ["zwei-K-pfe-9099442b", "scene-5ec1f7e7", "con-..-x-238fb55b"]),
        (["index.html", "Page.css"], ["index.html-0eb54730", "Page.css-d804dc54"]),
        (["a", "a", "a", "a-2"], ["a", "a-ca978112", "a-ca978112-2", "a-2"]),
    ],
)
def test_names_suit_every_host(names: list[str], wanted: list[str]) -> None:
    assert site.distinct_names(names) == wanted


def test_the_address_of_a_scene_does_not_depend_on_others() -> None:
    for one, other in ("日本", "動画"), ("a b", "a-b"), ("kpc-player.js", "kpc-player-js"):
        both = site.distinct_names([one, other])
        assert both == [*site.distinct_names([one]), *site.distinct_names([other])]
    assert site.distinct_names(["Ko\u0308pfe"]) == site.distinct_names(["Köpfe"]), "as macOS writes it, too"
    assert site.distinct_names(["caf\udce9"])[0].startswith("caf-")


def test_one_scene_becomes_one_page(tmp_path: Path, quick_posters: None, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "made" / "site"
    assert kpshare.main([str(SAMPLE), "-o", str(folder)]) == 0
    said = capsys.readouterr().out
    size = sum(path.stat().st_size for path in folder.iterdir())
    assert "<kpc-player" in said and f"1 scene, {size:,} bytes" in said
    (folder / "mine").write_bytes(b"1")
    assert kpshare.main([str(SAMPLE), "-o", str(folder)]) == 0 and f"{size:,} bytes" in capsys.readouterr().out
    (folder / "mine").unlink()
    found = sorted(path.name for path in folder.iterdir())
    assert found == ["default.kpc", "index.html", "kpc-player.js", "kpc-worker.js", "page.css", "poster.jpg"]
    assert (folder / "default.kpc").read_bytes() == SAMPLE.read_bytes()
    page = Page((folder / "index.html").read_text())
    assert all((folder / address).is_file() for address in page.addresses())


def test_several_scenes_become_a_gallery(tmp_path: Path, quick_posters: None) -> None:
    scenes, folder = tmp_path / "my scenes", tmp_path / "site"
    scenes.mkdir()
    for name in ("one.kpc", "two 2.kpc"):
        shutil.copy(SAMPLE, scenes / name)
    named_twice = str(scenes / "one.kpc")
    assert kpshare.main(["--gallery", str(scenes), named_twice, "-o", str(folder)]) == 0
    gallery = Page((folder / "index.html").read_text())
    assert gallery.tags.count("img") == 2 and gallery.content("og:title") == "my scenes"
    pages = [address for address in gallery.addresses() if address.endswith("index.html")]
    assert pages == ["one/index.html", "two-2-0a37c70c/index.html"]
    for page in (folder / address for address in pages):
        assert all((page.parent / address).is_file() for address in Page(page.read_text()).addresses())


def test_scenes_of_one_title_are_told_apart_in_a_gallery() -> None:
    def page(**scenes: SharedScene) -> list[str]:
        return re.findall(r"<h2>(.*?)</h2><p>(.*?)</p>", site.gallery_page(scenes, "g"))

    vase, other = shared(title="Vase"), replace(shared(title="Vase"), name="other<")
    facts = vase.facts
    assert page(a=vase, b=shared(title="Ball")) == [("Vase", facts), ("Ball", facts)]
    assert page(a=vase, b=other) == [("Vase", f"scene.kpc, {facts}"), ("Vase", f"other&lt;.kpc, {facts}")]
    assert page(a=vase, b=vase) == [("Vase", f"a.kpc, {facts}"), ("Vase", f"b.kpc, {facts}")]


def test_what_is_published_keeps_its_address(
    tmp_path: Path, quick_posters: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also in a site of a version that numbered names of which only one could stay, and did not record them."""
    scenes, folder, with_record = tmp_path / "scenes", tmp_path / "site", site.with_record
    scenes.mkdir()

    def addresses(*names: str) -> list[str]:
        for name in names:
            shutil.copy(SAMPLE, scenes / f"{name}.kpc")
        assert kpshare.main(["--gallery", str(scenes), "-o", str(folder)]) == 0
        found = Page((folder / "index.html").read_text()).addresses()
        return [address.removesuffix("/index.html") for address in found if address.endswith("/index.html")]

    with monkeypatch.context() as older:
        older.setattr(site, "file_name", site._reduced)
        older.setattr(site, "with_record", lambda page, written, name=None: with_record(page, written))
        assert addresses("a b", "B") == ["B", "a-b"]
    assert addresses("c") == ["B", "a-b", "c"]
    assert addresses("a-b", "b") == ["B", "a-b", "a-b-d44362d6", "b-3e23e816", "c"]
    (scenes / "c.kpc").unlink()
    assert addresses() == ["B", "a-b", "a-b-d44362d6", "b-3e23e816"]


def test_the_page_of_someone_else_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "index.html").write_text("<h1>mine</h1>")
    assert kpshare.main([str(SAMPLE), "-o", str(tmp_path)]) == 2
    assert "is not a page of kpshare" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]


def test_a_scene_that_is_not_there_leaves_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert kpshare.main([str(tmp_path / "nosuch.kpc"), "-o", str(tmp_path / "a/site")]) == 1
    assert "nosuch.kpc: No such file" in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ([], "no scene is given"),
        (["--gallery", "missing"], "no such folder"),
        ([str(SAMPLE), "--title", "A"], "kpedit --title"),
        ([str(SAMPLE), "--url", "host/a"], "no address"),
        ([str(SAMPLE), "--url", "https://my host/a"], "'https://my host/a' is no address"),
        ([str(SAMPLE), "--url", "https://host:99999/"], "no address"),
        ([str(SAMPLE), "--url", "https://host..example/"], "no address"),
        ([str(SAMPLE), "--url", "https://user:secret@host/a"], "would be published"),
        ([str(SAMPLE), "--url", "https://host/a?b"], "followed by ? or #"),
        (["https://host/a.kpc"], "download"),
    ],
)
def test_what_cannot_be_shared_is_refused(
    arguments: list[str], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = kpshare.main([*arguments, "-o", str(tmp_path / "site")])
    except SystemExit as end:
        code = end.code
    assert code == 2 and reason in capsys.readouterr().err and not (tmp_path / "site").exists()


def test_another_file_of_the_name_of_the_scene_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / SAMPLE.name).write_text("mine")
    assert kpshare.main([str(SAMPLE), "-o", str(tmp_path)]) == 2
    assert f"{SAMPLE.name}: is another file, and stays" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [SAMPLE.name]


@pytest.mark.parametrize("name", ["poster.jpg", "page.css", "default.kpc", "kpc-player.js"])
def test_files_of_someone_else_stay_and_own_ones_are_replaced(
    tmp_path: Path, quick_posters: None, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    command = [str(SAMPLE), "-o", str(tmp_path)]
    (tmp_path / name).write_text("mine")
    assert kpshare.main(command) == 2 and f"{name}: is another file, and stays" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [name] and (tmp_path / name).read_text() == "mine"
    (tmp_path / name).unlink()
    assert kpshare.main(command) == 0
    page = tmp_path / "index.html"
    checksum = hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
    older = re.sub(" index.html=[0-9a-f]+", "", page.read_text())  # a page of a version that did not record itself
    older = older.replace(checksum, hashlib.sha256(b"older").hexdigest())
    page.write_text(older)
    (tmp_path / name).write_text("older")
    assert kpshare.main(command) == 0 and (tmp_path / name).read_bytes() != b"older", "its own file is replaced"
    (tmp_path / name).write_text("mine")
    assert kpshare.main(command) == 2 and (tmp_path / name).read_text() == "mine", "but not what was put in its place"


def test_a_page_that_was_changed_stays(tmp_path: Path, quick_posters: None, capsys: pytest.CaptureFixture[str]) -> None:
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    shutil.copy(SAMPLE, scenes / "a.kpc")
    command = ["--gallery", str(scenes), "-o", str(tmp_path / "site"), "--title", "two\r\nlines"]
    assert kpshare.main(command) == 0 == kpshare.main(command), "a site can be made anew"
    for page in (tmp_path / "site" / "a" / "index.html", tmp_path / "site" / "index.html"):
        written = page.read_bytes()
        page.write_bytes(written.replace(b"</body>", b"<p>mine</p></body>"))
        assert kpshare.main(command) == 2 and b"mine" in page.read_bytes()
        assert f"{page}: was changed after kpshare wrote it" in capsys.readouterr().err
        page.write_bytes(written)


def test_what_is_no_longer_shared_is_removed_unless_it_was_changed(
    tmp_path: Path, quick_posters: None, capsys: pytest.CaptureFixture[str]
) -> None:
    scenes, folder = tmp_path / "scenes", tmp_path / "site"
    scenes.mkdir()
    for name in ("a", "b", "c"):
        shutil.copy(SAMPLE, scenes / f"{name}.kpc")
    assert kpshare.main(["--gallery", str(scenes), "-o", str(folder)]) == 0
    (folder / "b" / "poster.jpg").write_bytes(b"mine")
    (folder / "mine").write_bytes(b"mine")
    again = [str(scenes / "c.kpc"), "-o", str(folder)]
    assert kpshare.main([str(scenes / "a.kpc"), *again]) == 0
    assert f"{folder / 'b' / 'poster.jpg'}: is no longer shared; it stays" in capsys.readouterr().err
    assert [path.name for path in (folder / "b").iterdir()] == ["poster.jpg"]
    assert kpshare.main(again) == 0
    assert f"{folder / 'a'}: is no longer shared, so removed" in capsys.readouterr().err
    found = {path.name for path in folder.iterdir()}
    assert found == {"b", "c.kpc", "index.html", "kpc-player.js", "kpc-worker.js", "mine", "page.css", "poster.jpg"}
    assert kpshare.main([str(folder / "c.kpc"), str(scenes / "a.kpc"), "-o", str(folder)]) == 0
    said = capsys.readouterr().err
    assert (folder / "c.kpc").exists() and "c.kpc: is no longer shared; it stays, since it is one of" in said


def test_what_lies_beside_an_edited_page_that_is_no_longer_shared_is_removed(
    tmp_path: Path, quick_posters: None, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, page = tmp_path / "site", tmp_path / "site" / "default" / "index.html"
    shutil.copy(SAMPLE, tmp_path / "a.kpc")
    assert kpshare.main([str(tmp_path / "a.kpc"), str(SAMPLE), "-o", str(folder)]) == 0
    page.write_text(page.read_text() + "edited")
    capsys.readouterr()
    assert kpshare.main(["--gallery", str(tmp_path), "-o", str(folder)]) == 0
    assert list(page.parent.iterdir()) == [page] and page.read_text().endswith("edited")
    lines = {line for line in capsys.readouterr().err.splitlines() if "no longer shared" in line}
    removed = {f"{page.parent / name}: is no longer shared, so removed" for name in ("default.kpc", "poster.jpg")}
    stays = f"{page}: is no longer shared; it stays, since it was changed after kpshare wrote it"
    assert lines == {f"kpshare: {line}" for line in (stays, *removed)}


def test_a_scene_that_lay_in_the_folder_is_never_replaced(
    tmp_path: Path, quick_posters: None, capsys: pytest.CaptureFixture[str]
) -> None:
    sources = [tmp_path / name / "a.kpc" for name in ("site", "copy", "other")]
    for source in sources:
        source.parent.mkdir()
        shutil.copy(SAMPLE, source)
    edited = with_metadata(SAMPLE.read_bytes(), Metadata({"title": "other"}))
    sources[2].write_bytes(edited)
    for shared_before in sources[:2]:
        assert kpshare.main([str(shared_before), "-o", str(tmp_path / "site")]) == 0
        assert kpshare.main([str(sources[2]), "-o", str(tmp_path / "site")]) == 2
        assert "a.kpc: is another file, and stays" in capsys.readouterr().err
        assert sources[0].read_bytes() == SAMPLE.read_bytes()
    sources[0].unlink()
    for source in sources[1:]:
        assert kpshare.main([str(source), "-o", str(tmp_path / "site")]) == 0, "its own copies are replaced"
    assert sources[0].read_bytes() == edited


def test_a_folder_that_another_run_writes_stays_as_it_is(
    tmp_path: Path, quick_posters: None, capsys: pytest.CaptureFixture[str]
) -> None:
    with claimed(tmp_path, "kpshare", {"sources": "others"}):
        held = sorted(tmp_path.iterdir())
        assert kpshare.main([str(SAMPLE), "-o", str(tmp_path)]) == 2
        assert "another kpshare with other options is at work there" in capsys.readouterr().err
        assert sorted(tmp_path.iterdir()) == held
    assert kpshare.main([str(SAMPLE), "-o", str(tmp_path)]) == 0
    assert not list(tmp_path.glob(".*"))


def test_what_is_no_scene_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.kpc").write_bytes(b"no scene")
    assert kpshare.main([str(tmp_path / "a.kpc"), "-o", str(tmp_path / "site")]) == 1
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "site").exists()


def test_all_scenes_are_checked_before_the_first_poster(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(kpshare, "render_poster", lambda scene: pytest.fail("a poster is rendered"))
    (tmp_path / "b.kpc").write_bytes(b"no scene")
    (tmp_path / "c.kpc").write_bytes(SAMPLE.read_bytes()[:30_000])
    scenes = [str(SAMPLE), *(str(tmp_path / f"{name}.kpc") for name in "abc")]
    assert kpshare.main([*scenes, "-o", str(tmp_path / "site")]) == 1 and not (tmp_path / "site").exists()
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(".kpc")[0] for line in lines] == [f"kpshare: {tmp_path / name}" for name in "abc"]


def test_a_clip_that_is_damaged_beyond_its_first_group_is_not_published(
    tmp_path: Path, quick_posters: None, capsys: pytest.CaptureFixture[str]
) -> None:
    clip = tmp_path / "clip.kpc"
    groups.write([groups.GroupInput.of(SAMPLE, start) for start in (0, 30)], clip)
    data = bytearray(clip.read_bytes())
    data[-100] ^= 1
    clip.write_bytes(data)
    assert kpshare.main([str(clip), "-o", str(tmp_path / "site")]) == 1
    said = capsys.readouterr().err
    assert "clip.kpc, group 1: chunk " in said and "is damaged" in said and not (tmp_path / "site").exists()


def read(url: str, **headers: str) -> tuple[bytes, dict[str, str]]:
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as answer:
        return answer.read(), {name.lower(): value for name, value in answer.headers.items()}


def test_a_browser_gets_page_player_and_scene(tmp_path: Path) -> None:
    scene = tmp_path / "a b.kpc"
    shutil.copy(SAMPLE, scene)
    with serving_pages([str(scene)]) as url:
        page, headers = read(url)
        assert headers["content-type"].startswith("text/html") and "access-control-allow-origin" not in headers
        addresses = Page(page.decode()).addresses()
        types = {address: read(url + address)[1]["content-type"] for address in addresses}
        assert "javascript" in types["kpc-player.js"] and "text/css" in types["page.css"]
        part, headers = read(url + "a-b-c8687a08.kpc", Range="bytes=4-9")
        assert part == SAMPLE.read_bytes()[4:10] and headers["content-range"] == f"bytes 4-9/{SAMPLE.stat().st_size}"


@pytest.mark.parametrize(
    "host", ["a.example", "a.example:{port}", "127.0.0.1", "localhost.a.example:1", "127.0.0.1.a.example:{port}"]
)
def test_names_that_were_made_to_lead_here_are_refused(host: str) -> None:
    with serving_pages([str(SAMPLE)]) as url:
        port = url.rstrip("/").rpartition(":")[2]
        for name in "localhost", "LOCALHOST", "127.0.0.1", "[::1]":
            assert read(url, Host=f"{name}:{port}")[0]
        assert read(url, Host="localhost:1")[0]  # as through a tunnel
        for path in "", "default.kpc":
            with pytest.raises(urllib.error.HTTPError, match="421"):
                read(url + path, Host=host.format(port=port))


def test_a_folder_is_played_without_what_cannot_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, cut, foreign = tmp_path / "a.kpc", tmp_path / "b.kpc", tmp_path / "c.kpc"
    shutil.copy(SAMPLE, whole)
    cut.write_bytes(SAMPLE.read_bytes()[:30_000])
    foreign.write_bytes(b"no scene")
    with serving_pages([str(path) for path in (whole, cut, foreign)], memory=300_000_000) as url:
        addresses = Page(read(url)[0].decode()).addresses()
        assert [address for address in addresses if address.endswith("index.html")] == ["a/index.html", "b/index.html"]
        assert "30 KB" in read(url)[0].decode()
        assert ("kpc-player", "memory", "300000000") in Page(read(url + "b/")[0].decode()).attributes
        assert len(read(url + "b/b.kpc")[0]) == 30_000
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and "cut off at 30,000 of" in said[0] and said[0].endswith("what is there is played")
    assert said[1].startswith(f"kpplay: {foreign}: ") and said[1].endswith("; left out")
    with pytest.raises(FormatError), serving_pages([str(foreign)]):
        pass


def test_a_gallery_shows_names_of_files_that_addresses_cannot_have(tmp_path: Path) -> None:
    scenes = [tmp_path / "Größe 1.kpc", tmp_path / "Größe 2.kpc"]
    for scene in scenes:
        shutil.copy(SAMPLE, scene)
    with serving_pages([str(scene) for scene in scenes]) as url:
        page = read(url)[0].decode()
        assert "Größe 1.kpc" in page and "Größe 2.kpc" in page


def test_a_scene_elsewhere_may_be_loaded_from_there_alone(tmp_path: Path) -> None:
    with serving_pages([str(SAMPLE)]) as host:
        with serving_pages([f"{host}default.kpc", str(SAMPLE)]) as url:
            gallery = Page(read(url)[0].decode())
            page = Page(read(url + "default/")[0].decode())
            assert ("kpc-player", "src", f"{host}default.kpc") in page.attributes
            policy = page.content("Content-Security-Policy")
            assert policy.endswith(f"connect-src 'self' {host.rstrip('/')}")
            pages = [address for address in gallery.addresses() if "default" in address]
            assert pages == ["default/index.html", "default-37a8eec1/index.html"]


def test_options_of_the_window_are_refused_for_a_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert kpplay.main(["--web", str(SAMPLE), "--frames", "3"]) == 2
    assert "--frames" in capsys.readouterr().err


def test_no_page_loads_from_elsewhere() -> None:
    for page in (site.scene_page(shared()), site.gallery_page({"a": shared()}, "g")):
        assert not re.findall(r"https?://", page)


def test_a_password_in_an_address_is_refused_before_the_browser_does(capsys: pytest.CaptureFixture[str]) -> None:
    assert kpplay.main(["--web", "https://me:secret@host.invalid/a.kpc"]) == 2
    assert kpplay.main(["--web", str(SAMPLE), "--folder", "films"]) == 2
    said = capsys.readouterr().err
    assert "no user and password" in said and "secret" not in said and "--folder: is for the window" in said
