"""The valid conformance vectors: by name, a file and whether it is a prefix of one."""

from dataclasses import replace
from functools import cache, partial

import numpy as np

from kpc.encoder.coding.scene_writer import scene_chunks
from kpc.format.coding.poses import BITS, NOTHING, ROOT
from kpc.format.coding.quantise import QuantisedPlane, QuantisedScene
from kpc.format.container.container import Chunk, Reader
from kpc.format.container.scene_layout import (
    APPEARANCE_LIMIT,
    AXIS_LIMIT,
    BOX_LIMIT,
    CAMERA_LIMIT,
    CHANNEL_LIMIT,
    FRAME_LIMIT,
    HIDDEN_LIMIT,
    MOTION_LIMIT,
    NAME_LIMIT,
    SAMPLE_LIMIT,
    SCALE_LIMIT,
)
from kpc.format.container.segments import WEIGHT_COUNT
from kpc.format.scene.cameras import Camera
from kpc.format.scene.motion import QuantisedMotion
from kpc.format.scene.scene import SPACE_PLANES, Appearance, Clip, Decoder, HybridDecoder
from kpc.format.scene.space import Contraction, DeviceCoordinates
from kpc.tools.vectors.files import (
    assemble,
    encode,
    encode_kinds,
    poses,
    predictive,
    raw,
    smallest,
    transform,
    with_poses,
    zstd,
)
from kpc.tools.vectors.scenes import (
    at_rest,
    extreme_decoder,
    flat_zeros,
    hybrid_decoder,
    jumping_motion,
    make_appearances,
    make_scene,
    minimal_scene,
    noise,
    on_trellis,
    painted,
    smooth,
    smooth_motion,
    with_few_cells,
    with_occupancy,
)

Vector = tuple[bytes, bool]  # a file, and whether it is a prefix

small = partial(encode, store=smallest)


def prefix(data: bytes, chunk: int) -> Vector:
    """Return the part of a file before a chunk."""
    return data[: Reader(data).index[chunk].offset], True


def extremes(shape: tuple[int, int, int], seed: int) -> np.ndarray:
    """Return symbols that are the largest or the smallest."""
    return np.where(noise(shape, seed) < 0, -128, 127)


@cache
def valid() -> dict[str, Vector]:
    """Return all vectors but those of groups; one process makes them once."""
    dynamic = make_scene(dynamic=True, sizes=[(2, 5, 4, 3, 3), (4, 9, 8, 7, 6)], cameras=2)
    dense = replace(
        make_scene(dynamic=True, sizes=[(2, 9, 8, 7, 3)], cameras=1), occupancy=noise((2, 3, 3, 5), 98) > -64
    )
    files = {name: (data, False) for name, data in limits().items()}
    return files | _scenes(dynamic, dense) | _planes(dynamic) | _grids(dense) | _payloads(dense)


def _scenes(dynamic: QuantisedScene, dense: QuantisedScene) -> dict[str, Vector]:
    """Return vectors of what a scene may have, stored without context coding."""
    minimal = minimal_scene()
    raw_file, chunks = encode(dynamic, segment_rows=4), scene_chunks(minimal)
    contracted, moved = replace(dense, mapping=Contraction(3.5)), replace(dense, motion=jumping_motion(4, 3, 2, 5))
    frame = np.array([[0.96, 0, 0.28, 0.5], [0, 1, 0, -0.25], [-0.28, 0, 0.96, 3]])
    ndc = replace(
        dense,
        mapping=DeviceCoordinates(frame, 1.5, 2.0),
        aabb=np.array([[-0.5, -0.5, 0.125], [0.5, 0.5, 1.25]], np.float32),
    )
    hybrid = replace(dense, decoder=hybrid_decoder(2, 5, 3))
    varied = replace(dense, appearances=make_appearances("north.mp4", "süd.mp4", "東/0003.jpg"))
    coarse_ends = next(entry.offset for entry in Reader(raw_file).index if entry.scale == 1)
    note = raw(Chunk("note", b"readers skip what they need not know"))
    stored = [raw(chunk) for chunk in chunks]
    return {
        "minimal": (encode(minimal), False),
        "static": (encode(make_scene(dynamic=False, sizes=[(3, 17, 13, 11, 0)])), False),
        "dynamic": (raw_file, False),
        "dynamic-prefix": (raw_file[:coarse_ends], True),
        "one-texel": (encode(make_scene(dynamic=True, sizes=[(1, 1, 1, 1, 1)])), False),
        "wrap": (encode(make_scene(dynamic=False, sizes=[(8, 12, 10, 6, 0)], amplitude=400)), False),
        "contracted": (encode(contracted), False),
        "contracted-prefix": prefix(encode(contracted), 4),
        "moved": (encode(moved), False),
        "moved-prefix": prefix(encode(moved), 4),
        "moved-contracted": (encode(replace(contracted, motion=jumping_motion(2, 2, 2, 2, 32.0))), False),
        "device-coordinates": (encode(ndc), False),
        "hybrid": (encode(hybrid), False),
        "hybrid-moved": (encode(replace(hybrid, motion=moved.motion, decoder=hybrid_decoder(2, 1, 1))), False),
        "appearances": (encode(varied), False),
        "appearances-prefix": prefix(encode(varied), 4),
        "unknown-ancillary": (assemble([*stored[:3], note, *stored[3:]], 12), False),
        "zstd": (encode(replace(varied, mapping=contracted.mapping, motion=moved.motion), store=zstd), False),
        "zstd-hybrid": (encode(hybrid, store=zstd), False),
        "time-empty": (encode(at_rest(dynamic), segment_rows=4), False),
        "inexact-steps": (encode(_inexact_steps()), False),
    }


def _inexact_steps() -> QuantisedScene:
    """Return a scene whose values differ if a fused multiply-add computes them."""
    scene = painted(noise)
    planes = {
        name: replace(plane, step=np.full(3, 0.1, np.float32), offset=np.full(3, 0.3, np.float32))
        for name, plane in scene.scales[0].items()
    }
    return replace(scene, scales=(planes,))


def _planes(dynamic: QuantisedScene) -> dict[str, Vector]:
    """Return vectors of plane segments under PREDICTIVE and TRANSFORM."""
    one_texel = make_scene(dynamic=True, sizes=[(3, 1, 1, 1, 1)])
    small_scene = make_scene(dynamic=True, sizes=[(2, 9, 6, 5, 4)])
    sparse = with_few_cells(make_scene(dynamic=False, sizes=[(3, 41, 38, 35, 0)]))
    slits = with_few_cells(make_scene(dynamic=True, sizes=[(2, 11, 8, 9, 6), (3, 20, 13, 17, 6)]))
    wide_slits = with_few_cells(make_scene(dynamic=True, sizes=[(2, 29, 21, 16, 5)]))
    fine = make_scene(dynamic=False, sizes=[(2, 20, 17, 9, 0)])
    sides = [np.zeros((1, 3, 3, 5), bool) for _ in range(2)]
    sides[0][..., 1] = sides[1][..., 3] = True
    left, right = (flat_zeros(with_occupancy(make_scene(dynamic=False, sizes=[(1, 9, 6, 5, 0)]), one)) for one in sides)
    nothing = painted(lambda shape, seed: np.zeros(shape), coded=False)
    flat = painted(lambda shape, seed: noise(shape, seed) // 50)
    constant = painted(lambda shape, seed: np.full(shape, (127, -128, 1)[seed % 3]))
    return {
        "predictive": (predictive(dynamic, 8, segment_rows=4), False),
        "predictive-prefix": prefix(predictive(dynamic, 2), 9),
        "predictive-extremes": (predictive(painted(extremes), 4), False),
        "predictive-noise": (predictive(painted(noise), 2), False),
        "predictive-contexts": (_in_all_contexts(), False),
        "predictive-constant": (predictive(constant), False),
        "predictive-empty": (predictive(nothing), False),
        "predictive-one-texel": (predictive(one_texel), False),
        "predictive-implied": (predictive(slits, 2, segment_rows=4, implied=True), False),
        # Scenes whose planes have the same bytes and other maps.
        "predictive-implied-left": (predictive(left, implied=True), False),
        "predictive-implied-right": (predictive(right, implied=True), False),
        "predictive-time-empty": (predictive(at_rest(dynamic)), False),
        "trellis": (predictive(on_trellis(dynamic), 8, segment_rows=4), False),
        "trellis-extremes": (predictive(on_trellis(painted(extremes)), 4), False),
        "dependent": (predictive(dynamic, 8, segment_rows=4, is_dependent=True), False),
        "dependent-extremes": (predictive(painted(extremes), 4, is_dependent=True), False),
        "dependent-flat": (predictive(flat, 2, is_dependent=True), False),
        "transform": (transform(dynamic, 16, 12, 60, segment_rows=4), False),
        "transform-prefix": prefix(transform(dynamic, 8, 64, 8), 9),
        "transform-eight": (transform(make_scene(dynamic=True, sizes=[(2, 20, 17, 9, 4)]), 8, 20, 100), False),
        "transform-sparse": (transform(sparse, 4, 24, 24), False),
        "transform-extremes": (transform(small_scene, 4, 255, 8196), False),
        "transform-large": (transform(make_scene(dynamic=False, sizes=[(2, 33, 20, 17, 0)]), 16, 255, 8196), False),
        "transform-fine": (transform(fine, 16, 1, 8196), False),
        "transform-empty": (transform(nothing, 8, 64, 0), False),
        "transform-one-texel": (transform(one_texel, 4, 64, 20), False),
        "transform-implied": (transform(wide_slits, 8, 20, 100, implied=True), False),
    }


def _in_all_contexts() -> bytes:
    """Return a file that, with the other vectors, has residuals in every context that there can be (found by trial).

    Planes full of ends of the range under weights that predict them badly, and one that hardly changes.
    """
    weights = noise((2, WEIGHT_COUNT), 3025).astype(np.int8)
    weights[0, 8] = 24

    def paint(shape: tuple[int, int, int], number: int) -> np.ndarray:
        values = noise(shape, 3026 + number)
        return values > 120 if number == 2 else np.where(values < 0, -128, np.where(values > 90, 122, 127))

    return predictive(painted(paint, size=(9, 9, 9)), weights=weights)


def _grids(dense: QuantisedScene) -> dict[str, Vector]:
    """Return vectors of occupancy and motion grids under their codecs."""
    y, x = np.indices((6, 9))
    rolling = np.stack(
        [np.stack([(x - s - 4) ** 2 + (y - 2) ** 2 + (z - 3) ** 2 < 8 for z in range(5)]) for s in range(3)]
    )
    moved = replace(dense, motion=jumping_motion(4, 3, 2, 5))
    ends = QuantisedMotion(np.where(noise((3, 2, 4, 3, 3), 43) < 0, -32768, 32767).astype(np.int16), 0.5**13)

    def occupied(cells: np.ndarray, scene: QuantisedScene = dense) -> Vector:
        return encode_kinds(replace(scene, occupancy=cells), "OCCU"), False

    def moving(motion: QuantisedMotion) -> Vector:
        return encode_kinds(replace(dense, motion=motion), "MOVE"), False

    return {
        "occupancy": occupied(rolling),
        "occupancy-noise": occupied(dense.occupancy),
        "occupancy-prefix": prefix(encode_kinds(dense, "OCCU"), 4),
        "occupancy-thin": occupied(noise((1, 1, 1, 70), 97) > 0, minimal_scene()),
        "occupancy-one": occupied(np.ones((1, 1, 1, 1), bool), minimal_scene()),
        "occupancy-long-times": occupied(noise((40, 1, 2, 1), 96) > 0),
        "motion": moving(smooth_motion(6, 4, 3, 5)),
        "motion-noise": moving(jumping_motion(4, 3, 2, 5)),
        "motion-prefix": prefix(encode_kinds(moved, "MOVE"), 5),
        "motion-extremes": moving(ends),
        "motion-smallest": moving(jumping_motion(2, 2, 2, 2)),
        "motion-uneven": moving(smooth_motion(12, 2, 8, 7)),
    }


def _payloads(dense: QuantisedScene) -> dict[str, Vector]:
    """Return vectors of decoders and cameras under their codecs."""
    plain = make_scene(dynamic=False, sizes=[(1, 2, 2, 2, 0)], cameras=1)
    some = noise((5, 6), 83).astype(int) * 500
    rotations = [(k % 4, *some[k, :3].tolist()) for k in range(5)]
    positions = [tuple((some[k, 3:] + NOTHING).tolist()) for k in range(5)]
    five = with_poses(plain, poses(-17, (-131072, 3, 99999), rotations, positions))
    turns = [
        (largest, *others)
        for largest in range(4)
        for others in ((-ROOT, -ROOT, 0), (ROOT, 0, ROOT - 1), (0, 0, -NOTHING), (0, 0, 0))
    ]
    far = [(k & 1, k >> 1 & 1, 0) for k in range(len(turns))]
    near = poses(-24, (-5, 1 << 24, -7), 3 * [(0, 3, 4, 5)], [(1, 0, 2), (0, 9, 0), (4, 4, 0)], lenses=3)
    least = poses(-126, (-(1 << 31), 0, (1 << 31) - 1), [(3, 0, 0, 0)], [((1 << BITS) - 1, 1, 0)])
    weights = encode_kinds(dense, "DECO")
    assert isinstance(dense.decoder, Decoder)
    return {
        "weights": (weights, False),
        "weights-prefix": prefix(weights, 4),
        "weights-hybrid": (encode_kinds(replace(dense, decoder=hybrid_decoder(2, 5, 3)), "HYBR"), False),
        "weights-extremes": (encode_kinds(replace(dense, decoder=extreme_decoder(dense.decoder)), "DECO"), False),
        "poses": (five, False),
        "poses-prefix": prefix(five, 4),
        "poses-lenses": (with_poses(plain, near), False),
        "poses-extremes": (with_poses(plain, poses(30, (-1, 0, -1), turns, far)), False),
        "poses-small": (with_poses(plain, least), False),
    }


def limits() -> dict[str, bytes]:
    """Return files at the limits of the format, each as small as may be; none at the limit of chunks.

    One function, since it is a table of files.
    """
    plain = make_scene(dynamic=False, sizes=[(1, 2, 2, 2, 0)], cameras=1)
    moving = make_scene(dynamic=True, sizes=[(1, 2, 2, 2, 2)])
    deep = make_scene(dynamic=False, sizes=SCALE_LIMIT * [(1, 2, 1, 1, 0)])
    many = make_scene(dynamic=False, sizes=[(CHANNEL_LIMIT, 2, 1, 1, 0)])
    axes = make_scene(
        dynamic=True, sizes=[(1, AXIS_LIMIT, 1, 2, 1), (1, 2, AXIS_LIMIT, 1, 2), (1, 1, 2, AXIS_LIMIT, 1)]
    )
    rows = make_scene(dynamic=True, sizes=[(1, 1, 2, 1, AXIS_LIMIT)])
    pose = np.diag([1.0, 1, 1, 1])
    names = [chr(0x4E00 + k) for k in range(APPEARANCE_LIMIT)]
    periodic = noise((97,), 71) / np.float32(64)

    def repeated(shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
        return {name: np.resize(periodic, shape) for name, shape in shapes.items()}

    return {
        "limits-scales": small(
            replace(deep, decoder=replace(deep.decoder, density_weight=np.zeros(SCALE_LIMIT, np.float32)))
        ),
        "limits-channels": small(many),
        "limits-axes": small(
            smooth(replace(axes, occupancy=np.ones((1, 1, 1, AXIS_LIMIT), bool))), segment_rows=AXIS_LIMIT
        ),
        "limits-rows": small(
            smooth(replace(rows, occupancy=np.ones((AXIS_LIMIT, 1, 1, 1), bool))), segment_rows=AXIS_LIMIT
        ),
        "limits-motion": small(
            replace(
                moving,
                motion=QuantisedMotion(
                    np.resize(np.array([-32768, 32767, 0], np.int16), (AXIS_LIMIT, 2, 2, 2, 3)), 1 / 32
                ),
            )
        ),
        "limits-nodes": encode_kinds(replace(moving, motion=smooth_motion(2, 2, 2, MOTION_LIMIT)), "OCCU", "MOVE"),
        "limits-hidden": small(
            replace(plain, decoder=Decoder(density_bias=0.5, **repeated(Decoder.shapes(1, HIDDEN_LIMIT))))
        ),
        "limits-hybrid": small(
            replace(
                plain,
                decoder=HybridDecoder(
                    density_bias=0.5, **repeated(HybridDecoder.shapes(1, HIDDEN_LIMIT, HIDDEN_LIMIT))
                ),
            )
        ),
        "limits-cameras": small(
            replace(
                plain, cameras=tuple(Camera(64 + k % 7, 48, 80.0, 80.5, 32.0, 24.0, pose) for k in range(CAMERA_LIMIT))
            )
        ),
        "limits-appearances": small(
            replace(plain, appearances=tuple(Appearance(name, np.zeros(3, np.float32)) for name in names))
        ),
        "limits-large": small(_large_values(plain)),
        "limits-small": small(_small_values(plain)),
    }


def _large_values(plain: QuantisedScene) -> QuantisedScene:
    """Return a scene whose numbers are as large as the format allows."""
    steps = np.array(
        [16, 8, 0.5**20, 0.5**149, 0.5**126], np.float32
    )  # the last two: the least number above 0, the least that is normal
    wide = {
        name: QuantisedPlane(
            np.tile(np.array([[[-128], [127], [1]]], np.int8), (1, 1, 5)),
            steps,
            np.array([0, -1024, 1, 0, 0.5**126], np.float32),
            np.ones((1, 3), bool),
        )
        for name in SPACE_PLANES[:2]
    }
    wide["yz"] = replace(wide["xy"], symbols=wide["xy"].symbols[:, :1], coded=np.ones((1, 1), bool))
    decoder = make_scene(dynamic=False, sizes=[(5, 1, 1, 1, 0)]).decoder
    return replace(
        plain,
        aabb=np.array([[-BOX_LIMIT] * 3, [BOX_LIMIT] * 3], np.float32),
        clip=Clip(FRAME_LIMIT, 5e-324),
        scales=(wide,),
        decoder=decoder,
        step=2.0**32 / SAMPLE_LIMIT,
        occupancy=np.zeros((1, 1, 1, 1), bool),
        background=np.array([0, 1, 1], np.float32),
        cameras=(
            Camera(
                65535,
                65535,
                BOX_LIMIT,
                BOX_LIMIT,
                -BOX_LIMIT,
                BOX_LIMIT,
                np.eye(4) + np.pad([[BOX_LIMIT]], ((0, 3), (3, 0))),
            ),
        ),
        appearances=make_appearances("n" * NAME_LIMIT, "é" * (NAME_LIMIT // 2)),
    )


def _small_values(plain: QuantisedScene) -> QuantisedScene:
    """Return a scene whose numbers are as small as the format allows."""
    return replace(
        plain,
        aabb=np.array([[0, 0, 0], [1 / BOX_LIMIT] * 3], np.float32),
        step=2.0**-33,
        clip=Clip(1, 1.7e308),
        occupancy=np.zeros((1, 1, 1, 1), bool),
        mapping=Contraction(1 / BOX_LIMIT),
    )
