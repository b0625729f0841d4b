"""The browser player's pictures in headless Chromium, drawn by SwiftShader, against the numpy reference."""

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kpc
import web_page
from kpc.format.common.fidelity import psnr
from kpc.format.container import groups
from kpc.format.container.groups import GroupInput
from kpc.format.scene.scene import Clip, Scene
from kpc.player.atlas import Layout
from kpc.player.cpu.picture import BLOCK
from kpc.player.cpu.reference import Part, blend, render
from kpc.player.cpu.reprojection import mismatched_blocks, sample_pixels
from kpc.player.gl import shader
from kpc.player.gl.programs import scene_defines
from kpc.player.gl.shader_constants import block_arrays, decoder_arrays
from kpc.player.quality import LEVELS
from partial_scenes import coded
from scenes import (
    VARIANTS,
    look_at,
    tiny_scene,
    unequal_scales,
    view_independent,
    with_appearances,
    with_contraction,
    with_hybrid_decoder,
    with_motion,
)

CAMERA = look_at((2.4, 1.0, 2.2), (0.1, 0.05, 0.05), 64, 48, 70.0)
TIME = 0.62
SCENES: dict[str, Callable[[], Scene]] = {
    **{name: lambda make=make: make(tiny_scene(4)) for name, make in VARIANTS.items()},
    "static": lambda: tiny_scene(6, dynamic=False),
    "static hybrid, contracted": lambda: with_hybrid_decoder(with_contraction(tiny_scene(6, dynamic=False))),
    "appearances": lambda: with_appearances(tiny_scene(4)),
    "appearances, hybrid": lambda: with_appearances(with_hybrid_decoder(tiny_scene(4))),
    "displaced, contracted": lambda: with_motion(with_contraction(tiny_scene(6)), most=0.5),
    "view-independent": lambda: view_independent(tiny_scene(6)),
    "unequal scales": unequal_scales,
}
PARTS = {Part.FULL: "all", Part.STATIC: "static", Part.DYNAMIC: "dynamic"}
FRAGMENTS = [
    "march.glsl", "fold.glsl", "upsample_plane.glsl", "present.glsl", "enlarge.glsl", "average.glsl", "changes.glsl",
]  # fmt: skip
DEFINES = [
    {"COMPUTE": 0, "COUNTED": 0, "DEPTH_LIMIT": 0, "MODE": 0, "ROWS": 1, "MOTION": 0},
    {"COMPUTE": 0, "COUNTED": 1, "DEPTH_LIMIT": 1, "MODE": 1, "ROWS": 0, "MOTION": 1},
]
# A constant. Python rounds the tenth digit of a tie to even, JavaScript up; float32 needs nine.
NUMBER = re.compile(r"-?\d\.\d{9}e[+-]\d+")


@dataclass(frozen=True)
class Shot:
    """A picture to draw, and what the reference makes of it."""

    scene: str
    level: str = "reference"
    part: Part = Part.FULL
    appearance: str | None = None
    time: float = TIME
    half_float: bool = False

    @property
    def file(self) -> str:
        return f"{self.scene} {'half' if self.half_float else ''}.kpc"

    @property
    def call(self) -> web_page.Call:
        job = {"file": self.file, "camera": web_page.camera_of(CAMERA), "time": self.time, "level": self.level}
        job |= {"part": PARTS[self.part], "appearance": self.appearance, "halfFloat": self.half_float}
        return "picture", [job]


SHOTS = [
    *(Shot(name) for name in SCENES),
    *(Shot(name, half_float=True) for name in ("displaced, contracted", "ndc")),
    *(Shot("displaced", part=part) for part in (Part.STATIC, Part.DYNAMIC)),
    *(Shot("box", time=time) for time in (0.0, 1.0)),
    *(Shot(name, appearance="dusk.jpg") for name in ("appearances", "appearances, hybrid")),
    *(Shot("groups", time=time) for time in (0.2, 0.31, 0.32, 0.95)),
]
# The least PSNR of the levels, dB, 2 dB and more below what they have. Edges in so small a picture suffer from a lower
# resolution; "auto" ends with a fine picture once all stands still.
LEAST_DB = {"fastest": 20, "faster": 20, "fast": 20, "balanced": 46, "fine": 50, "finer": 52, "auto": 50}
LEVEL_SHOTS = [Shot(name, level) for name in ("box", "hybrid", "contracted") for level in LEAST_DB]
ALL = SHOTS + LEVEL_SHOTS
# Pictures that follow each other, with small changes and large ones between them.
FOLLOWING_TIMES = (0.3, 0.302, 0.34, 0.36, 0.362)
FOLLOWING = [Shot(name, "balanced") for name in ("box", "displaced, contracted", "hybrid")]
# What is drawn before and after the context is lost.
LOST = Shot("displaced", "fine")


def clip_in_groups(folder: Path) -> bytes:
    """Return frames 0 to 10 and 6 to 16, of which the second has another size and moves nothing."""
    scenes = tiny_scene(0, scales=1), replace(tiny_scene(2, dynamic=False), clip=Clip(11, 10.0))
    groups.write(
        [GroupInput.of(coded(scene), start) for scene, start in zip(scenes, (0, 6), strict=True)], folder / "g"
    )
    return (folder / "g").read_bytes()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    scenes = {name: coded(make()) for name, make in SCENES.items()}
    return scenes | {"groups": clip_in_groups(tmp_path_factory.mktemp("clip"))}


@pytest.fixture(scope="module")
def results(files: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """Return what the page says: pictures of ALL, shaders of SCENES, pictures that follow each other and whole ones of
    FOLLOWING, two pictures of LOST, the table of levels, and objects left in the end."""
    calls = [shot.call for shot in ALL]
    for name in SCENES:
        calls += [("shaders", [Shot(name).call[1][0], FRAGMENTS, defines]) for defines in DEFINES]
    for shot in FOLLOWING:
        jobs = [replace(shot, time=time).call[1][0] for time in FOLLOWING_TIMES]
        calls += [("played", [jobs]), *(("picture", [job]) for job in jobs)]
    served = {shot.file: files[shot.scene] for shot in ALL}
    calls += [("lost", LOST.call[1]), ("levels", []), ("close", [])]
    return web_page.run(tmp_path_factory.mktemp("page"), served, calls)


def reference_of(shot: Shot, data: bytes) -> np.ndarray:
    """Return (H, W, 3) in [0, 1]."""
    if shot.scene == "groups":
        shares = kpc.load(data).blend_at(shot.time)
        return blend([(render(scene, CAMERA, time), share) for scene, time, share in shares]).rgb.clip(0, 1)
    scene = kpc.load(data)
    code = None if shot.appearance is None else scene.appearance(shot.appearance)
    return render(scene, CAMERA, shot.time, part=shot.part, appearance=code).rgb.clip(0, 1)


@pytest.mark.parametrize("shot", SHOTS, ids=lambda shot: " ".join(map(str, asdict(shot).values())))
def test_gives_the_reference_picture(shot: Shot, results: list[Any], files: dict[str, bytes]) -> None:
    drawn, wanted = results[ALL.index(shot)], reference_of(shot, files[shot.scene])
    got = web_page.picture_of(drawn, CAMERA)
    assert drawn["error"] == 0
    assert wanted.std() > 0.01
    assert np.mean(np.abs(got - wanted).max(axis=-1) <= 2 / 255) >= 0.99
    assert psnr(got, wanted) >= 45


@pytest.mark.parametrize("shot", LEVEL_SHOTS, ids=lambda shot: f"{shot.scene} {shot.level}")
def test_levels_are_near_the_reference(shot: Shot, results: list[Any], files: dict[str, bytes]) -> None:
    got = web_page.picture_of(results[ALL.index(shot)], CAMERA)
    assert psnr(got, reference_of(shot, files[shot.scene])) >= LEAST_DB[shot.level]


def test_shaders_are_composed_as_for_the_desktop(results: list[Any], files: dict[str, bytes]) -> None:
    composed = iter(results[len(ALL) :])
    for name in SCENES:
        scene = kpc.load(files[name])
        layout = Layout.of(scene)
        arrays = decoder_arrays(scene.decoder, scene, layout), block_arrays(scene, layout)
        written = dict(zip(("decoder_weights", "plane_blocks"), map(shader.constants, arrays), strict=True))
        for defines in DEFINES:
            macros = scene_defines(scene, layout) | defines
            for fragment, got in zip(FRAGMENTS, next(composed), strict=True):
                text, files_in_it = shader.compose(fragment, macros, shader.Language.WEB, written)
                assert got["files"] == files_in_it
                assert NUMBER.sub("#", got["text"]) == NUMBER.sub("#", text)
                numbers, wanted = (np.array(NUMBER.findall(each), np.float32) for each in (got["text"], text))
                np.testing.assert_array_equal(numbers, wanted)


def following(before: np.ndarray, whole: np.ndarray, turn: int, tolerance: float) -> np.ndarray:
    """Return what a picture (H, W, 3) becomes that follows another, rows from below."""
    rows, columns = sample_pixels(turn, (before.shape[1], before.shape[0]))
    changed = mismatched_blocks(whole[rows, columns], before[rows, columns], tolerance)
    is_marched = changed.repeat(BLOCK, 0).repeat(BLOCK, 1)[: len(before), : before.shape[1]]
    is_marched[rows, columns] = True
    return np.where(is_marched[..., None], whole, before)


@pytest.mark.parametrize("number", range(len(FOLLOWING)), ids=lambda n: FOLLOWING[n].scene)
def test_pictures_follow_each_other_while_the_camera_rests(number: int, results: list[Any]) -> None:
    shot, count = FOLLOWING[number], 1 + len(FOLLOWING_TIMES)
    first = len(ALL) + len(SCENES) * len(DEFINES) + number * count
    played, *whole = results[first : first + count]
    assert all(picture["error"] == 0 for picture in (*played, *whole))
    shown, alone = ([web_page.picture_of(picture, CAMERA)[::-1] for picture in group] for group in (played, whole))
    np.testing.assert_array_equal(shown[0], alone[0])
    for turn, (before, picture, wanted) in enumerate(zip(shown, shown[1:], alone[1:], strict=False)):
        # Shaders compare floats, this test bytes: where that makes a difference, either is right.
        tolerances = (LEVELS[shot.level].reprojection_tolerance + offset for offset in (-2 / 255, 2 / 255))
        either = [following(before, wanted, turn, tolerance) for tolerance in tolerances]
        assert np.mean(np.min([np.abs(picture - each).max(axis=-1) for each in either], axis=0) > 1 / 255) < 0.001
        assert (picture != before).any()
    assert any((picture != wanted).any() for picture, wanted in zip(shown, alone, strict=True))


def test_the_levels_are_those_of_the_desktop(results: list[Any]) -> None:
    names = {"folded": "folded", "step": "step", "termination": "termination", "resolution": "resolution"}
    names |= {"raysAcross": "rays_across", "tolerance": "reprojection_tolerance"}
    assert list(results[-2]) == list(LEVELS)
    for level, quality in results[-2].items():
        assert quality == {name: getattr(LEVELS[level], field) for name, field in names.items()}


def test_a_lost_context_comes_back(results: list[Any]) -> None:
    before, after = results[-3]
    assert before["pixels"] == after["pixels"] and after["error"] == 0


def test_nothing_is_left_on_the_card(results: list[Any]) -> None:
    assert results[-1] == 0
