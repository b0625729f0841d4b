"""What README.md and the pages under docs/ show must work."""

import importlib
import itertools
import re
import shlex
import tomllib
from pathlib import Path

import pytest

import gl
from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.images import read_image
from kpc.format.scene.cameras import load_views
from scenes import tiny_scene

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")]
PAGES += [ROOT / "samples" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
README_LINES = 150
PICTURE_LIMIT_BYTES = 200_000


def blocks(language: str, page: Path) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as code hosts make them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= README_LINES


@pytest.mark.parametrize("example", blocks("python", ROOT / "docs" / "python.md"))
def test_python_examples_run(example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if "offscreen" in example:
        gl.context()
    scene = tiny_scene()
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.01) for scale in scene.scales]), tmp_path / "scene.kpc")
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "python.md", "exec"), {"__name__": "example"})
    if "still.png" in example:
        assert read_image(tmp_path / "still.png").shape == (72, 96, 3)


def test_every_option_of_every_command_exists(capsys: pytest.CaptureFixture[str]) -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    lines = [shlex.split(line) for page in PAGES for block in blocks("sh", page) for line in block.splitlines() if line]
    commands = [line for line in lines if line[0] in scripts or line[:2] == ["python", "-m"]]
    assert {line[0] for line in commands} == {*scripts, "python"}
    for name, *arguments in commands:
        module, _, function = (f"{arguments[1]}:main" if name == "python" else scripts[name]).partition(":")
        about = arguments[:1] if name == "kpbench" else []
        with pytest.raises(SystemExit):
            getattr(importlib.import_module(module), function)([*about, "--help"])
        known = set(re.findall(r"--?[a-z][a-z-]*", capsys.readouterr().out))
        arguments = list(itertools.takewhile(lambda argument: argument != "--", arguments))  # kpenc's follow
        used = {argument.split("=")[0] for argument in arguments[2 * (name == "python") :] if argument.startswith("-")}
        assert used <= known, f"{name} {shlex.join(arguments)}"


def test_the_camera_file_shown_can_be_read(tmp_path: Path) -> None:
    (example,) = blocks("json", ROOT / "docs" / "rendering.md")
    (tmp_path / "cameras.json").write_text(example)
    assert load_views(tmp_path / "cameras.json")[0].time == 0.5


def test_the_keys_shown_are_those_of_the_player() -> None:
    from kpc.player.app.input import KEY_BINDINGS

    assert (
        "".join(f"| {binding.keys} | {binding.help} |\n" for binding in KEY_BINDINGS)
        in (ROOT / "docs" / "playing.md").read_text()
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere_and_pictures_are_small(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if target.startswith("https://"):
            continue
        path, _, section = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), target
        assert not section or section in anchors(file), target
    for target in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text()):
        assert (page.parent / target).stat().st_size < PICTURE_LIMIT_BYTES
