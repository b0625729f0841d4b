"""Points and meshes of kpexport, read by trimesh."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpc.encoder.coding.scene_writer import write
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.images import linear_from_srgb, srgb_from_linear
from kpc.format.common.progress import Progress
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.scene import SPACE_PLANES, Clip, Decoder, Scene
from kpc.player.cpu.reference import SceneAtTime
from kpc.tools.cli import kpexport
from kpc.tools.exchange.field import box_points, densities, density_grid, plane_coordinates
from kpc.tools.exchange.gltf import GltfReader
from kpc.tools.exchange.options import DENSITY
from kpc.tools.exchange.placement import rotation_to_y
from kpc.tools.rendering.claims import claimed
from scenes import VARIANTS, look_at, tiny_scene, with_contraction

trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed, which reads what kpexport writes")

CENTRE, WIDTH = np.array([0.3, 0.1, -0.2]), 0.9
# The logarithm of the density is STEEPNESS f - OFFSET, with f = exp(-|p - CENTRE|^2 / WIDTH^2).
STEEPNESS, OFFSET = 40.0, 20.0
RADIUS = WIDTH * np.sqrt(-np.log((np.log(DENSITY) + OFFSET) / STEEPNESS))
TEXELS = 65

Run = Callable[..., tuple[int, str, str]]


def ball(up: tuple[float, float, float] | None = None, metres_per_unit: float = 1.0) -> Scene:
    """Return a ball around CENTRE, whose red grows with x and whose blue with z."""
    base = tiny_scene(dynamic=False)
    aabb = np.array([[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]], np.float32)
    axis = np.linspace(-1.5, 1.5, TEXELS)
    planes = {}
    for name in SPACE_PLANES:
        a, b = (axis - CENTRE["xyz".index(letter)] for letter in name)
        bump = np.exp(-(b[:, None] ** 2 + a[None, :] ** 2) / (2 * WIDTH**2))
        planes[name] = np.stack([bump, *[np.ones_like(bump)] * 3], axis=-1).astype(np.float32)
    planes["xy"][..., 2] = axis[None, :]
    planes["xz"][..., 3] = axis[:, None]
    b2 = np.zeros((3, 4), np.float32)
    b2[0, 2], b2[1, 1], b2[2, 3] = 2.0, -1.0, 2.0
    decoder = Decoder(
        density_weight=np.array([STEEPNESS, 0, 0, 0], np.float32),
        density_bias=-OFFSET,
        w1=base.decoder.w1,
        b1=base.decoder.b1,
        w2=np.zeros((3, 4, 16), np.float32),
        b2=b2,
    )
    eyes = [(4.0, 0.5, 0.3), (-4.0, 0.3, -0.4), (0.3, 0.6, 4.0), (0.2, 0.5, -4.0)]
    members = {} if up is None else {"up": list(up), "metres_per_unit": metres_per_unit}
    return replace(
        base,
        aabb=aabb,
        clip=Clip(1, 10.0),
        scales=(planes,),
        decoder=decoder,
        occupancy=np.ones((1, 8, 8, 8), bool),
        step=0.03,
        cameras=tuple(look_at(eye, tuple(CENTRE), 40, 30, 40.0) for eye in eyes),
        metadata=Metadata(members),
    )


def save(scene: Scene, path: Path) -> Path:
    write(quantise_scene(scene, [dict.fromkeys(scale, 0.002) for scale in scene.scales]), path)
    return path


def colours_at(points: np.ndarray) -> np.ndarray:
    red, blue = (1 / (1 + np.exp(-2 * points[:, axis])) for axis in (0, 2))
    return np.stack([red, np.full(len(points), 1 / (1 + np.e)), blue], axis=1)


@pytest.fixture(scope="module")
def ball_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(ball(), tmp_path_factory.mktemp("ball") / "ball.kpc")


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*arguments: object) -> tuple[int, str, str]:
        try:
            code = kpexport.main([str(a) for a in arguments])
        except SystemExit as error:  # argparse
            code = int(error.code or 0)
        output = capsys.readouterr()
        return code, output.out, output.err

    return call


def test_points_lie_on_the_surface_in_its_colours(run: Run, ball_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "points.ply"
    code, printed, _ = run(ball_file, "-o", out, "--backend", "reference", "--normals")
    assert code == 0 and printed.startswith(f"{out}: ")
    cloud = trimesh.load(out, process=False)
    points = np.asarray(cloud.vertices)
    assert len(points) > 500
    # the expected depth lies within a step or two of the isosurface, in a density that grows steeply
    assert np.abs(np.linalg.norm(points - CENTRE, axis=1) - RADIUS).max() < 0.1
    assert (np.ptp(points, axis=0) > RADIUS).all()
    assert np.abs(np.asarray(cloud.visual.vertex_colors)[:, :3] / 255 - colours_at(points)).max() < 0.04
    header = out.read_bytes().split(b"end_header")[0]
    assert b"property float nx" in header
    body = np.frombuffer(
        out.read_bytes().split(b"end_header\n", 1)[1],
        [("p", "<f4", 3), ("n", "<f4", 3), ("rgb", "u1", 3)],
    )
    outward = (body["p"] - CENTRE) / np.linalg.norm(body["p"] - CENTRE, axis=1, keepdims=True)
    assert (body["n"] * outward).sum(1).min() > 0.95


def test_two_runs_do_not_mix_their_files_in_a_folder(run: Run, ball_file: Path, tmp_path: Path) -> None:
    with claimed(tmp_path, "kpexport", {"input": "another.kpc"}):
        code, _, said = run(ball_file, "--backend", "reference", "-o", tmp_path)
        assert code == 2 and "another kpexport with other options is at work there" in said
    assert not list(tmp_path.iterdir())


def test_locks_of_interrupted_runs_are_removed_and_those_at_work_kept(tmp_path: Path) -> None:
    with claimed(tmp_path, "kpexport", {"input": "a.kpc"}):
        (own,) = tmp_path.iterdir()
        own.with_name(own.name.replace(".lock", "-killed.lock")).touch()
        with claimed(tmp_path, "kpexport", {"input": "a.kpc"}):
            assert own in tmp_path.iterdir() and len(list(tmp_path.iterdir())) == 2
    assert not list(tmp_path.iterdir())


def test_a_mesh_is_closed_and_faces_outwards(run: Run, ball_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("skimage", reason="scikit-image is not installed, which makes meshes")
    out = tmp_path / "mesh.glb"
    code, _, errors = run(ball_file, "-o", out, "--mesh", "--resolution", 32)
    assert code == 0, errors
    (mesh,) = trimesh.load(out, process=False).geometry.values()
    assert mesh.is_watertight
    assert abs(mesh.volume / (4 / 3 * np.pi * RADIUS**3) - 1) < 0.03
    assert np.abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS).max() < 0.03
    reader = GltfReader(out)
    (primitive,) = reader.document["meshes"][0]["primitives"]
    linear = reader.floats(primitive["attributes"]["COLOR_0"], "VEC3")
    # rays that graze the ball see colours from deeper and farther on, so the mean alone is compared
    assert np.abs(linear - linear_from_srgb(colours_at(mesh.vertices))).mean() < 0.02
    lengths = np.linalg.norm(reader.floats(primitive["attributes"]["NORMAL"], "VEC3"), axis=1)
    assert np.abs(lengths - 1).max() < 1e-5
    position = reader.document["accessors"][primitive["attributes"]["POSITION"]]
    assert np.allclose([position["min"], position["max"]], mesh.bounds)


@pytest.mark.parametrize("is_mesh", [False, True])
def test_the_bar_moves_within_a_file(
    run: Run, ball_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_mesh: bool
) -> None:
    """A file may take minutes, and all of its parts together are one file."""
    reach = Progress.reach
    reached: list[float] = []
    monkeypatch.setattr(Progress, "reach", lambda self, done: (reached.append(done), reach(self, done)))
    words = ["--mesh", "--resolution", "12"] if is_mesh else ["--size", "16x12"]
    assert run(ball_file, "-o", tmp_path / "out.ply", *words)[0] == 0
    assert len(set(reached)) >= 4 and reached == sorted(reached) and reached[-1] == 1


def test_meshes_in_ply_have_the_same_shape(run: Run, ball_file: Path, tmp_path: Path) -> None:
    pytest.importorskip("skimage", reason="scikit-image is not installed, which makes meshes")
    assert run(ball_file, "-o", tmp_path / "mesh.ply", "--mesh", "--resolution", 24)[0] == 0
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert mesh.is_watertight and mesh.volume > 0
    code, _, error = run(ball_file, "-o", tmp_path / "mesh.ply", "--mesh", "--resolution", 24, "--density", "1e9")
    assert code == 2 and "no surface" in error


def test_the_up_and_the_unit_of_the_scene_are_used(run: Run, tmp_path: Path) -> None:
    scene = ball(up=(0, 0, 2), metres_per_unit=0.5)
    out = tmp_path / "points.glb"
    code, _, said = run(save(scene, tmp_path / "ball.kpc"), "-o", out, "--backend", "reference")
    assert code == 0 and "y is up, in metres" in said
    (cloud,) = trimesh.load(out, process=False).geometry.values()
    middle = (cloud.vertices.max(0) + cloud.vertices.min(0)) / 2
    assert np.abs(middle - 0.5 * CENTRE[[0, 2, 1]] * [1, 1, -1]).max() < 0.02


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (0, -1, 0), (0.6, 0, 0.8), (-0.6, -0.8, 0)])
def test_up_becomes_y(up: tuple[float, float, float]) -> None:
    rotation = rotation_to_y(np.array(up))
    assert np.allclose(rotation @ up, [0, 1, 0]) and np.isclose(np.linalg.det(rotation), 1)
    assert np.allclose(rotation @ rotation.T, np.eye(3))


def test_frames_of_a_clip_go_into_a_folder(run: Run, tmp_path: Path) -> None:
    scene = save(tiny_scene(4), tmp_path / "tiny.kpc")
    code, printed, error = run(
        scene, "-o", f"{tmp_path}/frames/", "--format", "glb", "--frames", "2-6", "--step", 4,
        "--backend", "reference",
    )  # fmt: skip
    assert code == 0 and "2 files" in printed, error
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["0002.glb", "0006.glb"]
    code, _, error = run(scene, "-o", tmp_path / "points.ply")
    assert code == 2 and "11 frames do not go into one file" in error


def test_only_the_box_of_a_contracted_scene_is_exported(run: Run, tmp_path: Path) -> None:
    scene = with_contraction(tiny_scene(4))
    out = tmp_path / "points.ply"
    code, _, said = run(save(scene, tmp_path / "scene.kpc"), "-o", out, "--time", 0.5, "--backend", "reference")
    assert code == 0 and "only what lies in the box" in said
    points = trimesh.load(out, process=False).vertices
    assert ((points >= scene.aabb[0] - 1e-5) & (points <= scene.aabb[1] + 1e-5)).all()


@pytest.mark.parametrize(
    ("arguments", "possible"),
    [
        (["scene.kpc", "-o", "points.obj"], ".ply or .glb"),
        (["points.ply", "-o", "cameras.json"], "points.ply: is by its name neither a scene (.kpc) nor"),
        (["scene.kpc", "-o", ""], "the name is empty"),
        (["scene.kpc", "-o", "points.ply", "--format", "glb"], "contradicts"),
        (["scene.kpc", "-o", "points.ply", "--resolution", "64"], "--mesh"),
        (["scene.kpc", "-o", "points.ply", "--keyframes"], "cameras"),
        (["scene.kpc", "-o", "cameras.usda", "--mesh"], "own cameras"),
        (["path.json", "-o", "path.fbx"], ".gltf, .usda, .usd, .usdc"),
        (["path.gltf", "-o", "path.usda"], ".json"),
        (["path.json", "-o", "path.usda", "--mesh"], "scenes"),
    ],
)
def test_what_is_not_possible_is_a_usage_error(run: Run, arguments: list[str], possible: str) -> None:
    code, _, error = run(*arguments)
    assert code == 2 and possible in error


def test_the_curve_of_srgb_and_its_inverse_fit() -> None:
    values = np.linspace(0, 1, 33)
    assert np.abs(srgb_from_linear(linear_from_srgb(values)) - values).max() < 1e-7


@pytest.mark.parametrize("variant", ["box", "contracted", "ndc"])
def test_the_grid_of_a_mesh_covers_the_box(variant: str) -> None:
    scene = VARIANTS[variant](tiny_scene(4))
    moment = SceneAtTime.of(scene, 0.5)
    counts = (6, 4, 4)  # no point inside lies where two cells of the occupancy grid meet
    grid = density_grid(scene, moment, counts)[1:-1, 1:-1, 1:-1]
    inside = (np.linspace(0, 1, count)[1:-1] for count in counts)
    shares = np.stack(np.meshgrid(*inside, indexing="ij"), axis=-1).reshape(-1, 3)
    there = densities(scene, moment, plane_coordinates(scene, box_points(scene, shares)))
    assert (grid > 0).any() and np.allclose(there, grid.ravel(), rtol=1e-3)


def test_scenes_in_device_coordinates_become_meshes(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("skimage", reason="scikit-image is not installed, which makes meshes")
    scene = save(VARIANTS["ndc"](tiny_scene(4)), tmp_path / "scene.kpc")
    out = tmp_path / "mesh.ply"
    code, _, error = run(scene, "-o", out, "--mesh", "--resolution", 16, "--density", 1, "--time", 0.5)
    assert code == 0, error
    mesh = trimesh.load(out, process=False)
    assert np.isfinite(mesh.vertices).all() and mesh.volume > 0
