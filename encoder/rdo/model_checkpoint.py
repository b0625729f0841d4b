"""Finished checkpoints: a trained scene in full precision, with the validation rays that codings are judged on.

A checkpoint is a PyTorch file of plain tensors and numbers; reading it executes nothing.
"""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kpc.encoder.coding import scene_writer
from kpc.encoder.evaluation.validation_rays import ValidationRays
from kpc.encoder.training.checkpoint import save_state
from kpc.format.coding.quantise import quantise_scene
from kpc.format.common.errors import FormatError, TrainingError
from kpc.format.container.metadata_chunk import pack_metadata, parse_metadata
from kpc.format.scene.cameras import Camera
from kpc.format.scene.scene import Appearance, Clip, Decoder, HybridDecoder, Scene
from kpc.format.scene.sound import Sound
from kpc.format.scene.space import Contraction, DeviceCoordinates, SpaceMapping

CHECKPOINT_MAGIC = b"PK"  # PyTorch writes ZIP archives
VERSION = 2


def save_checkpoint(path: Path, scene: Scene, validation: ValidationRays) -> None:
    """Write all that coding needs, as plain tensors and numbers.

    Raises:
        TrainingError: the file cannot be written; an earlier file at `path` is left unchanged.
    """
    kind = "hybrid" if isinstance(scene.decoder, HybridDecoder) else "explicit"
    state = {
        "kpc": VERSION,
        "aabb": scene.aabb,
        "frame_count": scene.clip.frame_count,
        "fps": float(scene.clip.fps),
        "scales": scene.scales,
        "kind": kind,
        "decoder": vars(scene.decoder),
        "occupancy": scene.occupancy,
        "background": scene.background,
        "step": float(scene.step),
        "cameras": np.array([_camera_to_array(camera) for camera in scene.cameras]).reshape(-1, 22),
        "mapping": _mapping_to_dict(scene.mapping),
        "motion": scene.motion,
        "metadata": pack_metadata(scene.metadata).decode(),
        "names": [appearance.name for appearance in scene.appearances],
        "codes": [appearance.code for appearance in scene.appearances],
        "sound": _sound_to_dict(scene.sound),
        "validation_rays": vars(validation),
    }
    state = _map_values(state, np.ndarray, lambda a: torch.from_numpy(np.ascontiguousarray(a)))
    save_state(path, state, "name another --keep-checkpoint")


def read_checkpoint(path: Path) -> tuple[Scene, ValidationRays]:
    """Read what `save_checkpoint` wrote. Nothing in it is executed, and it takes a few times its size of memory at
    most.

    Raises:
        TrainingError: it is something else, damaged, or breaks a rule of .kpc files.
    """
    try:
        with zipfile.ZipFile(path) as archive:  # entries that are not compressed cannot exceed the file's size
            entries = archive.infolist()
            if any(entry.compress_type for entry in entries) or sum(e.file_size for e in entries) > path.stat().st_size:
                raise ValueError("compressed")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict) or state.get("kpc") != VERSION:
            raise TrainingError(
                f"{path}: no finished checkpoint; kpenc DATASET --keep-checkpoint writes one, --resume goes on "
                "from one of a run"
            )
        state = _map_values(state, torch.Tensor, _as_array)
        scene = _scene_from_state(state)
        validation = ValidationRays(**state["validation_rays"])
        _check(scene, validation)
        # A scene that no .kpc file can hold is refused here, by the rules of the reader, before anything is rendered.
        scene_writer.scene_chunks(
            quantise_scene(scene, [dict.fromkeys(scale, 8.0) for scale in scene.scales], skip_unseen=False)
        )
    except (TrainingError, OSError):
        raise
    except FormatError as error:
        raise TrainingError(f"{path}: not a usable checkpoint ({error})") from error
    except Exception as error:  # a damaged file may raise anything
        raise TrainingError(
            f"{path}: not a usable checkpoint ({type(error).__name__}); copy it or train anew"
        ) from error
    return scene, validation


def _scene_from_state(state: Mapping[str, Any]) -> Scene:
    kind = {"explicit": Decoder, "hybrid": HybridDecoder}[state["kind"]]
    return Scene(
        state["aabb"],
        Clip(int(state["frame_count"]), float(state["fps"])),
        tuple(state["scales"]),
        kind(**state["decoder"]),
        state["occupancy"],
        state["background"],
        float(state["step"]),
        tuple(_camera_from_array(numbers) for numbers in state["cameras"]),
        _mapping_from_dict(state["mapping"]),
        state["motion"],
        tuple(Appearance(name, code) for name, code in zip(state["names"], state["codes"], strict=True)),
        parse_metadata(state.get("metadata", "{}").encode()),
        _sound_from_dict(state.get("sound")),
    )


def _sound_to_dict(sound: Sound | None) -> dict[str, Any] | None:
    if sound is None:
        return None
    lengths = np.array([len(packet) for packet in sound.packets], np.int64)
    packets = np.frombuffer(bytearray().join(sound.packets), np.uint8)
    head = {name: getattr(sound, name) for name in ("channels", "pre_skip", "sample_count")}
    return {**head, "lengths": lengths, "packets": packets}


def _sound_from_dict(state: Mapping[str, Any] | None) -> Sound | None:
    if state is None:
        return None
    ends, content = np.cumsum(state["lengths"]).tolist(), state["packets"].tobytes()
    packets = tuple(content[start:end] for start, end in zip([0, *ends], ends, strict=False))
    return Sound(state["channels"], state["pre_skip"], state["sample_count"], packets)


def _check(scene: Scene, rays: ValidationRays) -> None:
    """Check what coding relies on beyond the rules of files."""
    for planes in scene.scales:
        for name, plane in planes.items():
            if plane.dtype != np.float32 or min(plane.shape[:2]) < 2:
                raise ValueError(f"plane {name}")
    n = len(rays.times)
    shapes = {"origins": (n, 3), "directions": (n, 3), "times": (n,), "truth": (n, 3)}
    for name, shape in shapes.items():
        values = getattr(rays, name)
        if values.shape != shape or values.dtype != np.float32 or not np.isfinite(values).all() or not n:
            raise ValueError(f"validation rays: {name}")
    lengths = np.linalg.norm(rays.directions, axis=1)
    if not ((np.abs(lengths - 1) < 1e-3).all() and (rays.times >= 0).all() and (rays.times <= 1).all()):
        raise ValueError("validation rays")
    appearances = rays.appearances
    if (appearances is None) != (not scene.appearances):
        raise ValueError("validation rays: appearances")
    if appearances is not None and (
        appearances.shape != (n,) or appearances.min() < 0 or appearances.max() >= len(scene.appearances)
    ):
        raise ValueError("validation rays: appearances")
    if scene.motion is not None and not np.isfinite(scene.motion).all():
        raise ValueError("motion")


def _camera_to_array(camera: Camera) -> np.ndarray:
    return np.array([camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy,
                     *np.ravel(camera.camera_to_world)], np.float64)  # fmt: skip


def _camera_from_array(numbers: np.ndarray) -> Camera:
    width, height, fl_x, fl_y, cx, cy = map(float, numbers[:6])
    return Camera(int(width), int(height), fl_x, fl_y, cx, cy, numbers[6:].reshape(4, 4))


def _mapping_to_dict(mapping: SpaceMapping | None) -> dict[str, Any] | None:
    return None if mapping is None else {"kind": type(mapping).__name__, **vars(mapping)}


def _mapping_from_dict(numbers: Mapping[str, Any] | None) -> SpaceMapping | None:
    if numbers is None:
        return None
    kinds: dict[str, type[SpaceMapping]] = {kind.__name__: kind for kind in (Contraction, DeviceCoordinates)}
    return kinds[numbers["kind"]](**{name: value for name, value in numbers.items() if name != "kind"})


def _map_values(value: Any, type_: type, change: Any) -> Any:
    """Return plain data with `change` applied to all values of a type; mappings become dicts, sequences lists."""
    if isinstance(value, type_):
        return change(value)
    if isinstance(value, Mapping):
        return {key: _map_values(item, type_, change) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_map_values(item, type_, change) for item in value]
    return value


def _as_array(tensor: torch.Tensor) -> np.ndarray:
    """Return a tensor as an array; refuse one that claims more values than are stored."""
    if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        raise ValueError("a tensor without its values")
    return np.ascontiguousarray(tensor.numpy())
