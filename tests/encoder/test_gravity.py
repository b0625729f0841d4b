"""Which way is up by gravity tags of photographs."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kpc.encoder.poses.find import find_poses
from kpc.encoder.poses.gravity import agreed_up, apple_acceleration, tagged_up, up_of_tags
from kpc.encoder.poses.orientation import up_direction
from kpc.encoder.poses.structure import PlacedView, Structure, oriented
from kpc.encoder.poses.wishes import Wishes
from kpc.format.common.images import CameraTags, camera_tags

# By which turn each EXIF orientation shows a stored picture: Pillow's own names.
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
DJI = '<x drone-dji:GimbalPitchDegree="{}" drone-dji:GimbalRollDegree="{}"/>'
GOOGLE = "<GPano:PosePitchDegrees>{}</GPano:PosePitchDegrees><GPano:PoseRollDegrees>{}</GPano:PoseRollDegrees>"


def note(acceleration: tuple[float, ...], *, denominator: int = 10**6, kind: int = 10) -> bytes:
    """Return Apple's MakerNote with a version, then the acceleration, in g, behind the directory."""
    values = b"".join(struct.pack(">ii", round(value * denominator), denominator) for value in acceleration)
    entries = struct.pack(">HHIi", 1, 9, 1, 14) + struct.pack(">HHII", 8, kind, len(acceleration), 44)
    return b"Apple iOS\0\0\x01MM" + struct.pack(">H", 2) + entries + bytes(4) + values


def photograph(file: Path, maker_note: bytes = b"", orientation: int = 1, lens: str = "", xmp: str = "") -> Path:
    """Write a photograph with these tags."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update({0x927C: maker_note, 0xA434: lens})
    Image.new("RGB", (8, 6)).save(file, exif=exif, **({"xmp": xmp.encode()} if xmp else {}))
    return file


def degrees(one: np.ndarray, two: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ two / np.linalg.norm(one) / np.linalg.norm(two), -1, 1))))


@pytest.mark.parametrize(
    "acceleration, orientation, up",
    [
        # tags in public listings: of a rocket in the sky, of two things within a metre, and of one 26 metres away
        ((0.02314, -0.93976, 0.34824), 6, (-0.02, 0.94, -0.35)),
        ((0.01901, -0.98015, -0.16765), 6, (-0.02, 0.98, 0.17)),
        ((-0.98428, 0.00586, -0.15764), 1, (0.01, 0.98, 0.16)),
        ((-0.89604, -0.07538, 0.43572), 1, (-0.08, 0.90, -0.44)),
        ((1.0, 0.0, 0.0), 3, (0, 1, 0)),  # lying on its right side
        ((0.0, 1.0, 0.0), 8, (0, 1, 0)),  # upside down
        ((0.0, 0.0, -1.0), 6, (0, 0, 1)),  # its camera looks down
    ],
)
def test_phones_know_what_is_up(tmp_path: Path, acceleration, orientation: int, up: tuple[float, ...]) -> None:
    found = tagged_up(photograph(tmp_path / "x.jpg", note(acceleration), orientation, "iPhone back camera"))
    assert found is not None and np.linalg.norm(found) == pytest.approx(1)
    assert degrees(found, np.array(up)) < 1


@pytest.mark.parametrize("orientation", range(2, 9))
def test_up_turns_with_the_picture(orientation: int) -> None:
    """What points at a bright spot in the picture as stored still does in the picture as shown."""
    acceleration = np.array([-0.64, -0.6, 0.48])
    stored_up = np.array([acceleration[1], -acceleration[0]])
    spot = np.zeros((101, 101), np.uint8)
    column, row = np.round(50 + 50 * stored_up * [1, -1]).astype(int)
    spot[row, column] = 255
    (row,), (column,) = np.nonzero(np.asarray(Image.fromarray(spot).transpose(TURNS[orientation])))
    up = up_of_tags(CameraTags(orientation, note(tuple(acceleration))))
    assert up == pytest.approx([(column - 50) / 50, (50 - row) / 50, -0.48], abs=0.011)


@pytest.mark.parametrize("turned", [(0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)])
def test_pixels_that_a_program_turned_stay_upright(turned: tuple[float, float]) -> None:
    """A decoder of HEIC gives orientation 1, however the phone was held."""
    sideways, down = np.array([turned[1], -turned[0]]) * 0.3, np.array(turned) * 0.9
    up = up_of_tags(CameraTags(1, note((*(down + sideways), 0.316))))
    assert up is not None
    assert up[1] == pytest.approx(0.9, abs=1e-3) and up[2] == pytest.approx(-0.316, abs=1e-3)
    assert abs(up[0]) == pytest.approx(0.3, abs=1e-3)


def test_front_cameras_have_no_tag() -> None:
    upright = note((0.0, -1.0, 0.0))
    assert up_of_tags(CameraTags(6, upright, "iPhone 13 front camera 2.71mm f/2.2")) is None
    assert up_of_tags(CameraTags(6, upright, "iPhone 13 back dual wide camera 5.1mm f/1.6")) is not None


@pytest.mark.parametrize("layout", [DJI, GOOGLE])
def test_pitch_and_roll(tmp_path: Path, layout: str) -> None:
    def up(pitch: str, roll: str) -> np.ndarray | None:
        return tagged_up(photograph(tmp_path / "x.jpg", xmp=layout.format(pitch, roll)))

    assert up("+0.00", "0") == pytest.approx([0, 1, 0])
    assert up("-90.00", "+0.00") == pytest.approx([0, 0, 1])  # looks down
    assert up("30", "0") == pytest.approx([0, np.sqrt(0.75), -0.5])  # looks up
    assert up("0.0", "+30") == pytest.approx([-0.5, np.sqrt(0.75), 0])  # its right side is lower
    for pitch, roll in (("nan", "0"), ("999", "0"), ("0", "-181"), ("", "0"), ("1e9", "0"), ("0" * 90, "0")):
        assert up(pitch, roll) is None


def test_angles_need_a_picture_as_stored_and_both_of_them() -> None:
    both = DJI.format(-30, 0).encode()
    assert up_of_tags(CameraTags(xmp=both)) is not None
    assert up_of_tags(CameraTags(6, xmp=both)) is None
    assert up_of_tags(CameraTags(xmp=both.replace(b"Roll", b"Yaw"))) is None


def test_a_note_that_is_cut_off_has_no_tag() -> None:
    whole = note((0.0, -1.0, 0.0))
    assert apple_acceleration(whole) == pytest.approx([0, -1, 0])
    for length in range(len(whole)):
        assert apple_acceleration(whole[:length]) is None, length


@pytest.mark.parametrize(
    "bad",
    [
        note((0.0, -1.0, 0.0), kind=5),
        note((0.0, -1.0)),
        note((0.0, 0.0, 0.0)),
        note((0.0, -0.7, 0.3)),
        note((0.0, -1.3, 0.0)),
        note((0.0, -1.0, 0.0), denominator=1)[:-4] + bytes(4),
        note((0.0, -1.0, 0.0)).replace(b"MM", b"II"),
        note((0.0, -1.0, 0.0)).replace(struct.pack(">I", 44), b"\xff\xff\xff\xff"),
        note((0.0, -1.0, 0.0)).replace(b"\0\x08\0\x0a", b"\0\x09\0\x0a"),
        b"Apple iOS\0\0\x01MM\xff\xff" + bytes(99),
        b"",
    ],
)
def test_malformed_notes_are_no_tag(tmp_path: Path, bad: bytes) -> None:
    assert apple_acceleration(bad) is None
    assert tagged_up(photograph(tmp_path / "x.jpg", bad)) is None


def test_damaged_tags_never_keep_a_picture_from_being_read(tmp_path: Path) -> None:
    """Each byte of EXIF and XMP is changed in turn; what is read is a unit vector or nothing."""
    file = photograph(tmp_path / "x.jpg", note((0.1, -0.97, 0.2)), 6, "back", DJI.format("-30.0", "+0.00"))
    content, rng, found = file.read_bytes(), np.random.default_rng(0), []
    exif, xmp = content.index(b"Exif"), content.index(b"http")
    for place in (*range(exif, xmp - 4), *range(xmp, content.index(b"/>"))):  # 4 bytes before each say how long it is
        file.write_bytes(content[:place] + rng.bytes(1) + content[place + 1 :])
        found.append(tagged_up(file))
        assert found[-1] is None or np.linalg.norm(found[-1]) == pytest.approx(1)
    assert 10 < sum(up is None for up in found) < 0.5 * len(found)


def test_pictures_without_tags_have_none(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "x.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "x.jpg", exif=b"Exif\0\0nonsense")
    assert camera_tags(tmp_path / "x.png") == camera_tags(tmp_path / "x.jpg") == CameraTags()
    assert tagged_up(tmp_path / "x.png") is None


def noisy(count: int, up: np.ndarray, spread: float, seed: int = 0) -> np.ndarray:
    """Return unit vectors (count, 3) near one, with so much noise in each coordinate."""
    votes = up + np.random.default_rng(seed).normal(0, spread, (count, 3))
    return votes / np.linalg.norm(votes, axis=1, keepdims=True)


def test_tags_agree_in_spite_of_noise_and_outliers() -> None:
    up = np.array([0.48, -0.6, 0.64])
    good, bad = noisy(14, up, 0.03), noisy(6, np.array([0.6, 0.8, 0.0]), 0.2, seed=1)
    agreed = agreed_up(np.concatenate([bad, good]))
    assert agreed is not None and agreed.agreeing == 14
    assert degrees(agreed.up, up) < 1.5 and np.linalg.norm(agreed.up) == pytest.approx(1)
    assert agreed_up(np.concatenate([bad, good[:10]])) is None  # 10 of 16


def test_tags_that_are_few_or_disagree_are_not_believed() -> None:
    up = np.array([0.0, 0.0, 1.0])
    assert agreed_up(np.zeros((0, 3))) is None
    assert agreed_up(np.stack([up, up])) is None
    assert agreed_up(np.stack([up, up, up])) is not None
    assert agreed_up(np.stack([up, -up, up, -up])) is None
    assert agreed_up(np.concatenate([np.eye(3), -np.eye(3)])) is None


def tilted(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return cameras (count, 4, 4) in a row that all look 50 degrees down, in a world that lies askew, and its up."""
    rng = np.random.default_rng(3)
    world = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    world *= np.linalg.det(world)
    down = np.radians(50)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = world @ [[1, 0, 0], [0, np.sin(down), -np.cos(down)], [0, np.cos(down), np.sin(down)]]
    poses[:, :3, 3] = np.arange(count)[:, None] * world[:, 0] + rng.normal(0, 0.1, (count, 3))
    return poses, poses[0, :3, :3] @ [0, np.cos(down), np.sin(down)]


def structure_of(poses: np.ndarray) -> Structure:
    views = {n: PlacedView(pose, (9.0, 9.0, 4.0, 3.0), (0.0,) * 4, 100, 0.2) for n, pose in enumerate(poses)}
    return Structure(views, poses[:, :3, 3] + 1.0, np.zeros((0, 4)), {})


def test_gravity_turns_tilted_cameras_upright() -> None:
    """Cameras that all look down alike show no horizon but their own."""
    poses, up = tilted(5)
    views = {n: PlacedView(pose, (9.0, 9.0, 4.0, 3.0), (0.0,) * 4, 100, 0.2) for n, pose in enumerate(poses)}
    structure = Structure(views, poses[:, :3, 3] + 1.0, np.zeros((0, 4)), {})
    tag = up_of_tags(CameraTags(xmp=DJI.format(-50, 0).encode()))
    agreed = agreed_up(np.stack([pose[:3, :3] @ tag for pose in poses]))
    assert agreed is not None and degrees(up_direction(poses), up) == pytest.approx(50)
    for view in oriented(structure, agreed.up, 2.0).views.values():
        assert view.camera_to_world[2, :3] == pytest.approx([0, np.cos(np.radians(50)), np.sin(np.radians(50))])


@pytest.mark.parametrize("rig", ["auto", "moving"])
@pytest.mark.parametrize(
    "pitches, said, lean",
    [
        (["-50"] * 6, "up follows gravity: 6 of 6 gravity tags agree", 0),
        (
            ["80"] * 6,
            "up follows gravity: 6 of 6 gravity tags agree; the horizons of the cameras differ by 80 degrees",
            130,
        ),
        (["-50", "-49", "-51", "-50", "20", None], "up follows gravity: 4 of 5 gravity tags agree", 0),
        (["-50", None, None, None, None, None], "up follows from the horizons of the cameras (only 1 gravity tag)", 50),
        (
            ["-50", "0", "50", "-90", "90", "-20"],
            "up follows from the horizons of the cameras (6 gravity tags disagree)",
            50,
        ),
        ([None] * 6, "up follows from the horizons of the cameras (no gravity tags)", 50),
    ],
)
def test_found_cameras_stand_upright(tmp_path, capsys, monkeypatch, rig, pitches, said, lean) -> None:
    poses, _ = tilted(6)
    views = {n: PlacedView(pose, (9.0, 9.0, 4.0, 3.0), (0.0,) * 4, 100, 0.2) for n, pose in enumerate(poses)}
    structure = Structure(views, poses[:, :3, 3] + 1.0, np.zeros((0, 4)), {})
    monkeypatch.setattr("kpc.encoder.poses.find.reconstruct", lambda *_: structure)
    monkeypatch.setattr("kpc.encoder.poses.find.check_installed", lambda: None)
    for number, pitch in enumerate(pitches):
        photograph(tmp_path / f"{number}.jpg", xmp="" if pitch is None else DJI.format(pitch, "+0.00"))
    found = find_poses(tmp_path, Wishes(rig=rig))
    (line,) = [line for line in capsys.readouterr().err.splitlines() if ": up follows" in line]
    assert f"{tmp_path}: {said}" in line
    for view in found.structure.views.values():
        tilt = np.degrees(np.arcsin(view.camera_to_world[2, 2]))  # the optical axis is so far below the horizon
        assert tilt == pytest.approx(50 - lean, abs=1)
