"""The metadata that kpenc writes: what its options say, how to look at the scene, and how the file was made."""

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kpc.encoder.cli.options import Options
from kpc.encoder.datasets import Dataset, camera_rays
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.format.common.version import VERSION
from kpc.format.scene.cameras import Camera
from kpc.format.scene.metadata import Metadata, merged, rounded
from kpc.format.scene.scene import Scene
from kpc.format.scene.space import DeviceCoordinates
from kpc.format.scene.view_limits import find_view, view_members

# Options that say where and when a run worked, not what it made, and those that the provenance names apart.
NOT_RECORDED = {
    "source", "output", "work", "cache", "keep", "resume", "device", "keep_checkpoint", "ablation", "test_views",
    "preview", "time_budget_s", "trade", "members", "view_limits", "preset", "seed", "only", "wishes",
}  # fmt: skip
# Bytes that the figures of `with_figures` may add to a file.
FIGURES_BYTES = 200


def describe(options: Options, dataset: Dataset, scene: Scene, cameras: list[int], dataset_sha256: str) -> Metadata:
    """Return the metadata of a trained scene with its cameras, without figures; arguments as for `describe_origin`."""
    return with_view(describe_origin(options, dataset, cameras, dataset_sha256), scene, options.view_limits)


def describe_origin(options: Options, dataset: Dataset, cameras: list[int], dataset_sha256: str) -> Metadata:
    """Return the metadata of a scene that are known before it is trained.

    Args:
        options: of the run.
        dataset: that it is trained on.
        cameras: pictures of the dataset that the cameras of the scene are of.
        dataset_sha256: of the whole dataset, `hash_dataset`.
    """
    names = [dataset.camera_names[dataset.pictures.camera[picture]] for picture in cameras]
    name, value = options.trade.bound
    fields = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    fields["downscale"] = dataset.downscale
    chosen = {
        option: _plain(fields[option])
        for option in fields
        if option not in NOT_RECORDED and fields[option] != getattr(Options, option, None)
    }
    metadata = Metadata().with_members(
        **options.members,
        transparent=True if dataset.has_alpha else None,
        up=[0.0, 0.0, 1.0] if dataset.poses_found else None,  # kpposes may know gravity, which the cameras do not show
        camera_names=[_printable(name) for name in names] or None,
    )
    return metadata.with_provenance(
        encoder=f"kpc {VERSION}",
        dataset_sha256=dataset_sha256,
        layout=dataset.layout,
        preset=options.preset,
        seed=options.seed,
        options={**chosen, **options.wishes.changed(), name: value},
    )


def with_view(metadata: Metadata, scene: Scene, wanted: str | Mapping[str, Any] | None) -> Metadata:
    """Return the metadata with up, an opening view and view limits, as --view-limits asks."""
    scene = replace(scene, metadata=metadata)  # whose up counts, if it is known
    renderer = SceneRenderer(scene)

    def look(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        origins, directions = camera_rays(camera, np.stack([column.ravel(), row.ravel()], axis=1))
        rays = scene.mapping.rays(origins, directions) if isinstance(scene.mapping, DeviceCoordinates) else None
        o, d = (origins, directions) if rays is None else (rays.origins, rays.directions)
        _, opacity, depth = renderer.render(o, d, np.full(len(o), 0.5, np.float32))
        return depth if rays is None else rays.distance(depth[:, None])[:, 0], opacity

    members = view_members(scene, *find_view(scene, look))
    if "view_limits" in members and isinstance(wanted, Mapping):
        members["view_limits"] |= wanted
    if wanted == "none":
        members.pop("view_limits", None)
    return metadata.with_members(**members)


def with_figures(metadata: Metadata, result: Mapping[str, Any]) -> Metadata:
    """Return the metadata with the quality that was measured, as `encode_scene` reports it."""
    held_out = {
        "pictures": result["test_pictures"],
        "psnr_db": result["test_psnr"],
        "ssim": result["test_ssim"],
        "moving_psnr_db": result["test_psnr_moving"],
        "still_psnr_db": result["test_psnr_still"],
    }
    known = {name: rounded([value])[0] for name, value in held_out.items() if value is not None and np.isfinite(value)}
    loss = result["coding_loss_db"]
    return metadata.with_provenance(
        held_out=known if result["test_pictures"] else None,
        coding_loss_db=None if loss is None or not np.isfinite(loss) else rounded([loss])[0],
    )


def clip_metadata(parts: Sequence[Metadata], result: Mapping[str, Any], options: Options) -> Metadata:
    """Return the metadata of a clip of groups with figures of the whole.

    Args:
        parts: of its groups.
        result: as for `with_figures`.
        options: of the clip, of which each group has its share of steps and bytes.
    """
    whole, (target, value) = merged(list(parts)), options.trade.bound
    given = {"steps": options.steps, "time_budget_s": options.time_budget_s, target: value}
    chosen = whole.provenance.get("options", {}) | {name: one for name, one in given.items() if one is not None}
    return with_figures(whole.with_provenance(options=chosen), result)


def hash_dataset(dataset: Dataset) -> str:
    """Return the SHA-256 of a dataset's files, their names, and its cameras and times, in hexadecimal."""
    digest, pictures = hashlib.sha256(), dataset.pictures
    for name in sorted(set(pictures.file)):
        with (dataset.path / name).open("rb") as opened:
            digest.update(name.encode(errors="surrogateescape") + b"\0")
            digest.update(hashlib.file_digest(opened, "sha256").digest())
    for numbers in (
        pictures.camera_to_world,
        pictures.intrinsics,
        pictures.distortion,
        pictures.is_fisheye,
        pictures.time,
    ):
        digest.update(np.ascontiguousarray(numbers, "<f8").tobytes())
    return digest.hexdigest()


def reserve_figures(options: Options) -> Options:
    """Return the options with a target size that leaves room for the figures of `with_figures`."""
    size = options.trade.target_bytes
    if size is None:
        return options
    return replace(options, trade=replace(options.trade, target_bytes=max(1, size - FIGURES_BYTES)))


def _plain(value: Any) -> str | int | float | bool:
    if isinstance(value, tuple):
        return ",".join(f"{number:g}" for number in value)
    return value if isinstance(value, int | float) else _printable(str(value))


def _printable(name: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in name)[:64] or "?"
