"""Every key of `transforms*.json` that is understood: what is read, what has no effect and why, what is refused.

A document's keys hold for all its frames, which may override them. What is not in the table is listed to the user.
docs/encoding.md has the same table, and a test keeps the two equal.

Sources: https://docs.nerf.studio/quickstart/data_conventions.html, and `nerf_loader.cu` in
https://github.com/NVlabs/instant-ngp
"""

from pathlib import Path
from typing import Any

from kpc.encoder.datasets.capture import first_names
from kpc.format.common.errors import DatasetError
from kpc.format.common.text import notice
from kpc.format.scene.camera_models import NO_PINHOLE_KEYS, check_unknown_keys

# Keys that are read.
READ = frozenset(
    "frames file_path transform_matrix time fps near far w h fl_x fl_y camera_angle_x camera_angle_y x_fov y_fov cx cy "
    "k1 k2 p1 p2 k3 k4 k5 k6 distortion_params camera_model camera_name camera_type is_fisheye mask_path "
    "enable_ray_loading "
    "train_filenames val_filenames test_filenames time_offset time_rate "
    "frame_count start_s videos bytes".split()
)

# Keys without effect, although other programs use them, by the reason that is given to the user.
WITHOUT_EFFECT = {
    "the poses already contain it": ("applied_transform", "applied_scale"),
    "the box follows from the cameras": ("aabb_scale", "offset", "scale", "aabb", "render_aabb"),
    "neither points nor depth pictures are used": (
        *("ply_file_path", "depth_file_path", "depth_path", "integer_depth_scale", "enable_depth_loading"),
    ),
    "all frames are used, as they are": (
        *("n_frames", "sharpness_discard_threshold", "sharpen"),
        *("white_transparent", "black_transparent", "fix_premult"),
    ),
    "not modelled": ("rolling_shutter", "transform_matrix_start", "transform_matrix_end", "driver_parameters"),
    "a setting of another trainer": (
        *("orientation_override", "up", "importance_sampling", "n_extra_learnable_dims", "envmap"),
    ),
}

# Keys that only inform; nothing is said about them.
INFORMATION = frozenset(("colmap_im_id", "rotation", "sharpness", "made_by", "kind", "unit"))

# Keys by which the camera is no pinhole or the pose means something else, by remedy. They are refused unless their
# value is 0, false, null or empty.
REFUSED = {
    "undistort the images to a pinhole": NO_PINHOLE_KEYS,
    "export the poses as nerfstudio has them": ("from_na", "from_mitsuba", "normal_mts_args"),
}


UNDERSTOOD = READ | INFORMATION | {n for table in (WITHOUT_EFFECT, REFUSED) for names in table.values() for n in names}


def check_keys(file: Path, document: dict[str, Any]) -> None:
    """Name once, in one line, all keys of a document and its frames that have no effect or are unknown.

    Raises:
        DatasetError: a key is refused; or one that is in no table is that of the table in other letters, or says that
            the camera is no pinhole.
    """
    frames = document["frames"]
    for where, keys in ((str(file), document), *((f"{file} frame {n}", frame) for n, frame in enumerate(frames))):
        for remedy, names in REFUSED.items():
            for name in names:
                if keys.get(name):
                    raise DatasetError(f"{where}: {name} is not supported; {remedy}")
        check_unknown_keys(where, keys, READ, UNDERSTOOD)
    present = dict.fromkeys(key for keys in (document, *frames) for key in keys)  # in order, each once
    without = {reason: [name for name in names if name in present] for reason, names in WITHOUT_EFFECT.items()}
    without["unknown"] = [key for key in present if key not in UNDERSTOOD]
    parts = [f"{first_names(names)} ({reason})" for reason, names in without.items() if names]
    if parts:
        notice(f"{file}: keys without effect: {'; '.join(parts)}")
