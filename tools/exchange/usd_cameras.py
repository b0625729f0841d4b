"""Cameras to and from USD (usd-core): focal lengths, apertures and offsets of the film back, with time samples.

A stage is y-up, in metres. Apertures and focal lengths count as millimetres; the width of the film back is that of
35 mm film. The attribute `kpc:size` holds the size of the pictures in pixels, `kpc:time` the clip's time, and
`kpc:name` the name of a camera where USD cannot have it.

    focalLength / horizontalAperture = fl_x / width     horizontalApertureOffset / horizontalAperture = 1/2 - cx / width
    focalLength / verticalAperture = fl_y / height      verticalApertureOffset / verticalAperture = cy / height - 1/2
"""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom

from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import DatasetError, MediaError
from kpc.format.common.text import check_unicode, valid_unicode
from kpc.format.scene.camera_checks import check_lens, check_pose
from kpc.format.scene.cameras import Camera, View
from kpc.format.scene.rotations import quaternion_of, rotation_of
from kpc.tools.exchange.camera_tracks import (
    MAX_VIEWS,
    Track,
    fitted,
    sampled_note,
    size_for,
    times_at,
    with_instants_between,
)
from kpc.tools.exchange.gltf import MAX_FILE_BYTES

FILM_WIDTH_MM = 36.0
NEAR, FAR = 0.01, 1e6


def write_usd_cameras(path: Path, tracks: Sequence[Track], fps: float) -> None:
    """Write cameras, placed (`kpc.tools.exchange.placement`).

    Args:
        path: of the file; .usda is text.
        tracks: the cameras.
        fps: time codes per second.

    Raises:
        MediaError, OSError: the file cannot be written.
    """
    check_unicode(path, "USD")
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    moving = [view.at_s for track in tracks for view in track.views if view.at_s is not None]
    if moving:
        stage.SetStartTimeCode(min(moving) * fps)
        stage.SetEndTimeCode(max(moving) * fps)
    root = UsdGeom.Xform.Define(stage, "/cameras")
    stage.SetDefaultPrim(root.GetPrim())
    used = set[str]()
    for number, track in enumerate(tracks):
        name = _identifier(track.name)
        if not name or name[0].isdigit() or name in used:
            name = f"camera_{number:04d}_{name}"
        used.add(name)
        _define(UsdGeom.Camera.Define(stage, f"/cameras/{name}"), track, fps)
    with atomic_write(path) as aside:
        try:
            stage.GetRootLayer().Export(str(aside))
        except Tf.ErrorException as error:
            reasons = re.findall(r": '(.*)'", str(error))
            raise MediaError(f"{path}: cannot be written ({(reasons or ['no reason given'])[0]})") from error


def read_usd_cameras(path: Path, size: tuple[int, int] | None) -> tuple[list[Track], list[str]]:
    """Read the perspective cameras of a .usda, .usd or .usdc file, and return what of them was guessed, too.

    Args:
        path: of the file.
        size: of the pictures; None for what the file says (`camera_tracks.size_for`).

    Raises:
        DatasetError: the file is malformed or refers to others, or a camera cannot be rendered.
        MediaError: its name is not valid Unicode.
    """
    check_unicode(path, "USD")
    if not path.is_file():
        raise DatasetError(f"{path}: no such file, or not a regular one; check the path")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise DatasetError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB; export the cameras alone")
    try:
        layer = Sdf.Layer.FindOrOpen(str(path))
        if layer is not None and layer.GetCompositionAssetDependencies():
            raise DatasetError(f"{path}: refers to other files; flatten it first (usdcat --flatten)")
        stage = None if layer is None else Usd.Stage.Open(layer)
    except Tf.ErrorException as error:
        raise DatasetError(f"{path}: not USD ({str(error)[:200]}); export it anew") from error
    if stage is None:
        raise DatasetError(f"{path}: not USD; export it anew")
    tracks: list[Track] = []
    guessed = set[str]()
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Camera):
            continue
        camera = UsdGeom.Camera(prim)
        if camera.GetProjectionAttr().Get() != UsdGeom.Tokens.perspective:
            guessed.add("orthographic cameras are left out")
            continue
        if len(tracks) == MAX_VIEWS:
            raise DatasetError(f"{path}: more than {MAX_VIEWS} cameras; export fewer")
        tracks.append(_track(f"{path}, camera {prim.GetPath()}", stage, camera, size, guessed))
    return tracks, sorted(guessed)


def _identifier(name: str) -> str:
    """Return what of a camera's name USD can have, which may be empty or begin with a digit."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)[:100]


def _define(prim: UsdGeom.Camera, track: Track, fps: float) -> None:
    """Set the attributes of a camera, with a time sample for each instant if it moves."""
    prim.CreateClippingRangeAttr(Gf.Vec2f(NEAR, FAR))
    first = track.views[0].camera
    size = prim.GetPrim().CreateAttribute("kpc:size", Sdf.ValueTypeNames.Int2)
    size.Set(Gf.Vec2i(first.width, first.height))
    if prim.GetPrim().GetName() != track.name:
        prim.GetPrim().CreateAttribute("kpc:name", Sdf.ValueTypeNames.String).Set(valid_unicode(track.name))
    pose = prim.AddTransformOp()
    time = prim.GetPrim().CreateAttribute("kpc:time", Sdf.ValueTypeNames.Double)
    attributes = (
        prim.CreateFocalLengthAttr(),
        prim.CreateHorizontalApertureAttr(),
        prim.CreateVerticalApertureAttr(),
        prim.CreateHorizontalApertureOffsetAttr(),
        prim.CreateVerticalApertureOffsetAttr(),
    )
    for view in track.views:
        camera = view.camera
        code = Usd.TimeCode.Default() if view.at_s is None else Usd.TimeCode(view.at_s * fps)
        focal = camera.fl_x / camera.width * FILM_WIDTH_MM
        film_height = focal * camera.height / camera.fl_y
        values = (
            focal,
            FILM_WIDTH_MM,
            film_height,
            FILM_WIDTH_MM * (0.5 - camera.cx / camera.width),
            film_height * (camera.cy / camera.height - 0.5),
        )
        for attribute, value in zip(attributes, values, strict=True):
            attribute.Set(value, code)
        pose.Set(Gf.Matrix4d(*camera.camera_to_world.T.ravel().tolist()), code)  # USD multiplies row vectors
        time.Set(view.time, code)


def _track(
    where: str, stage: Usd.Stage, camera: UsdGeom.Camera, size: tuple[int, int] | None, guessed: set[str]
) -> Track:
    """Return the track of a camera of a stage, y-up and in metres."""
    prim = camera.GetPrim()
    rate, fps = stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()
    if not (0 < rate < 1e6 and 0 < fps < 1e6):
        raise DatasetError(f"{where}: {rate:g} time codes and {fps:g} frames a second; correct the file")

    def poses(codes: np.ndarray) -> np.ndarray:
        return np.stack([_rigid(_pose(where, stage, camera, Usd.TimeCode(code))) for code in codes])

    keys = np.array(_codes(where, camera))
    are_all = _has_keyed_matrix(stage, camera)
    codes = (keys if are_all else with_instants_between(where, keys, poses, rate / fps)).tolist()
    if len(codes) > len(keys):
        guessed.add(sampled_note(fps))
    time = prim.GetAttribute("kpc:time")
    if not time:
        guessed.add("there are no times of the clip: it plays once along the path" if codes else "all times are 0")
    stored = prim.GetAttribute("kpc:size")
    stored_size = [int(n) for n in stored.Get()] if stored and stored.GetTypeName() == Sdf.ValueTypeNames.Int2 else None
    name, views = _name(prim), []
    known = [_time(where, time, code) for code in _time_codes(keys)] if time else None
    times = times_at(np.array(codes), keys, known)
    for number, code in enumerate(_time_codes(codes)):
        focal, film_width, film_height, shift_x, shift_y = (
            _number(where, attribute, code)
            for attribute in (
                camera.GetFocalLengthAttr(),
                camera.GetHorizontalApertureAttr(),
                camera.GetVerticalApertureAttr(),
                camera.GetHorizontalApertureOffsetAttr(),
                camera.GetVerticalApertureOffsetAttr(),
            )
        )
        if not (focal > 0 and film_width > 0 and film_height > 0):
            raise DatasetError(f"{where}: focal length and apertures must be positive; correct the camera")
        width, height, aspect = size_for(where, film_width / film_height, stored_size, size)
        film_width = film_height * aspect
        fl_x, fl_y = focal / film_width * width, focal / film_height * height
        cx, cy = (0.5 - shift_x / film_width) * width, (0.5 + shift_y / film_height) * height
        check_lens(where, (width, height), (fl_x, fl_y, cx, cy))
        file, at_s = (f"{number:04d}.png", codes[number] / rate) if codes else (f"{name}.png", None)
        pose = _pose(where, stage, camera, code)
        is_between = bool(codes) and codes[number] not in keys  # where USD may interpolate the entries of matrices
        made = Camera(width, height, fl_x, fl_y, cx, cy, _rigid(pose) if is_between else check_pose(where, pose))
        views.append(View(fitted(made, size), times[number], file, at_s))
    return Track(name, tuple(views))


def _name(prim: Usd.Prim) -> str:
    """Return the name of a camera: the one that `kpc:name` holds, unless another program has renamed it since."""
    stored = prim.GetAttribute("kpc:name")
    name = str(stored.Get() or "")[:200] if stored and stored.GetTypeName() == Sdf.ValueTypeNames.String else ""
    return name if name and prim.GetName().endswith(_identifier(name)) else str(prim.GetName())


def _codes(where: str, camera: UsdGeom.Camera) -> list[float]:
    """Return the time codes at which the camera or what holds it has samples, in order; empty if it stands still."""
    codes = set[float]()
    attributes = [attribute for attribute in camera.GetPrim().GetAttributes() if attribute.ValueMightBeTimeVarying()]
    for attribute in attributes:
        codes.update(attribute.GetTimeSamples())
    prim = camera.GetPrim().GetParent()
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable):
            codes.update(UsdGeom.Xformable(prim).GetTimeSamples())
        prim = prim.GetParent()
    if len(codes) > MAX_VIEWS:
        raise DatasetError(f"{where}: more than {MAX_VIEWS} time samples; export fewer")
    return sorted(codes)


def _has_keyed_matrix(stage: Usd.Stage, camera: UsdGeom.Camera) -> bool:
    """Return whether all that moves a camera is one matrix, whose rotation programs interpolate in their own way."""
    prim, moving = camera.GetPrim(), []
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable):
            moving += [op for op in UsdGeom.Xformable(prim).GetOrderedXformOps() if op.MightBeTimeVarying()]
        prim = prim.GetParent()
    is_matrix = len(moving) == 1 and moving[0].GetOpType() == UsdGeom.XformOp.TypeTransform
    return is_matrix and stage.GetInterpolationType() == Usd.InterpolationTypeLinear


def _rigid(pose: np.ndarray) -> np.ndarray:
    """Return a pose whose rotation is the one nearest to what the matrix holds."""
    rigid = pose.copy()
    rigid[:3, :3] = rotation_of(quaternion_of(pose[:3, :3]))
    return rigid


def _time_codes(codes: Iterable[float]) -> list[Usd.TimeCode]:
    return [Usd.TimeCode(float(code)) for code in codes] or [Usd.TimeCode.Default()]


def _time(where: str, attribute: Any, code: Usd.TimeCode) -> float:
    """Return the clip's time that a file stores."""
    found = _number(where, attribute, code)
    if not 0 <= found <= 1:
        raise DatasetError(f"{where}: kpc:time {found:g} lies outside [0, 1]; correct the file")
    return found


def _number(where: str, attribute: Any, code: Usd.TimeCode) -> float:
    value = attribute.Get(code)
    if not isinstance(value, (int, float)):
        raise DatasetError(f"{where}: {attribute.GetName()} is no number; correct the camera")
    return float(value)


def _pose(where: str, stage: Usd.Stage, camera: UsdGeom.Camera, code: Usd.TimeCode) -> np.ndarray:
    """Return camera-to-world at a time, y-up and in metres, with axes of length 1."""
    pose = np.array(camera.ComputeLocalToWorldTransform(code), float).T.copy()
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        pose = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]) @ pose
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    if not (np.isfinite(lengths).all() and (lengths > 0).all()):
        raise DatasetError(f"{where}: the pose is not finite, or has no size; correct the camera")
    pose[:3, :3] /= lengths  # what holds the camera may scale
    pose[:3, 3] *= UsdGeom.GetStageMetersPerUnit(stage)
    return pose
