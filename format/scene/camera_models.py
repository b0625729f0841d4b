"""The camera models of COLMAP and nerfstudio, by name: those that are understood, with their parameters.

Understood are OpenCV's two models, the rational one k1 k2 p1 p2 k3 k4 k5 k6 of a pinhole and the fisheye model k1 k2 k3
k4, and COLMAP's special cases of both. Whatever is not in `PARAMETERS` is refused.

Sources: https://colmap.github.io/cameras.html, https://docs.nerf.studio/quickstart/data_conventions.html
"""

import re
from collections.abc import Mapping, Set
from typing import Any

from kpc.format.common.errors import DatasetError
from kpc.format.common.text import one_line

# The understood models, with COLMAP's parameters in order; nerfstudio's files name the parameters themselves.
PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}

# Those of them that are special cases of OpenCV's fisheye model.
FISHEYE_MODELS = frozenset(name for name in PARAMETERS if name.endswith("FISHEYE"))

# Other names of understood models, in documents whose keys name the parameters.
OTHER_NAMES = {"PERSPECTIVE": "PINHOLE"}

# Keys of documents by which a camera is neither of both, unless their value is 0, false, null or empty.
NO_PINHOLE_KEYS = (
    *("fisheye", "fisheye_crop_radius", "latlong", "equirectangular", "orthographic"),
    *(f"ftheta_p{n}" for n in range(5)),
)

# Words that say that a camera is no pinhole, and the keys in whose values they are looked for.
_NO_PINHOLE = re.compile("fish.?eye|equi.?rect|lat.?long|f.?theta|panoram|spherical|omni.?dir|vr.?180", re.IGNORECASE)
_ABOUT_LENSES = re.compile("cam|lens|model|projection|distort", re.IGNORECASE)

# COLMAP's numbers of models in binary files, so that messages can name those that are refused.
COLMAP_NUMBERS = dict(
    enumerate(
        "SIMPLE_PINHOLE PINHOLE SIMPLE_RADIAL RADIAL OPENCV OPENCV_FISHEYE FULL_OPENCV FOV SIMPLE_RADIAL_FISHEYE "
        "RADIAL_FISHEYE THIN_PRISM_FISHEYE RAD_TAN_THIN_PRISM_FISHEYE SIMPLE_DIVISION DIVISION SIMPLE_FISHEYE FISHEYE "
        "EUCM EQUIRECTANGULAR".split()
    )
)


def understood_model(where: str, name: str) -> str:
    """Return the name of an understood camera model as `PARAMETERS` has it, whatever its case.

    Args:
        where: the calibration's file and entry, for messages.
        name: as the file has it, in printable form.

    Raises:
        DatasetError: the model is not understood.
    """
    model = OTHER_NAMES.get(name.upper(), name.upper())
    if model not in PARAMETERS:
        raise DatasetError(f"{where}: camera model {name} is not supported; undistort the images to a pinhole")
    return model


def check_unknown_keys(where: str, keys: Mapping[str, Any], read: Set[str], understood: Set[str]) -> None:
    """Refuse unknown keys of a document that matter: read ones in other letters, and ones that speak of no pinhole.

    Args:
        where: the file and entry, for messages.
        keys: the document's, or those of one of its frames.
        read: the keys that are read.
        understood: all keys that are known, which are not looked at.

    Raises:
        DatasetError: as above.
    """
    for key, value in keys.items():
        if key in understood:
            continue
        if (same := key.strip().lower()) in read:
            raise DatasetError(f"{where}: the key {key!r} is not read; write it {same}")
        says = isinstance(value, str) and _ABOUT_LENSES.search(key) and _NO_PINHOLE.search(value)
        if says or (value and _NO_PINHOLE.search(key)):
            what = one_line(f"{key}: {value}" if says else key)[:160]
            raise DatasetError(f"{where}: {what} is not supported; undistort the images to a pinhole")
