"""Tiny rigs of five cameras in the layouts of the programs that calibrate them, to be mutated by `fuzz_datasets`.

Each holds the images `images/0.png` to `images/4.png`, or has them where the layout wants them.
"""

import json
from typing import Any

# What each camera has: OpenCV's matrix, coefficients of distortion, rotation and translation.
Camera = tuple[list[list[float]], list[float], list[list[float]], list[float]]

UNTURNED = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def rigs(count: int, width: int, height: int, images: dict[str, bytes]) -> list[dict[str, bytes]]:
    """Return the files of a rig in every layout.

    Args:
        count: of cameras, which stand in a line.
        width, height: of the images, pixels.
        images: by name, as `images/0.png`.
    """
    matrix = [[9.0, 0.0, width / 2 - 0.5], [0.0, 9.0, height / 2 - 0.5], [0.0, 0.0, 1.0]]
    cameras = [(matrix, [0.01, 0.0, 0.0, 0.0, 0.0], UNTURNED, [-float(n), 0.0, 0.0]) for n in range(count)]
    size = [width, height]
    return [
        images | _easymocap(cameras, size),
        images | {"calibration_a.json": _panoptic(cameras, size)},
        images | {"camera_array.toml": _toml(cameras, size, "cameras.")},
        images | {"calibration.toml": _toml(cameras, size, "")},
        images | {"a.qca.txt": _qualisys(cameras, size)},
        images | {"rig.json": _opencv(cameras, size)},
        _nerfies(cameras, size, images),
    ]


def _json(document: Any) -> bytes:
    return json.dumps(document).encode()


def _easymocap(cameras: list[Camera], size: list[int]) -> dict[str, bytes]:
    def matrix(key: str, rows: int, values: list[float]) -> str:
        columns, data = len(values) // rows, ", ".join(map(str, values))
        return f"{key}: !!opencv-matrix\n  rows: {rows}\n  cols: {columns}\n  dt: d\n  data: [{data}]\n"

    head = "%YAML:1.0\n---\nnames:\n" + "".join(f'  - "{n}"\n' for n in range(len(cameras)))
    intri, extri = head, head
    for n, (k, dist, _, t) in enumerate(cameras):
        intri += (
            matrix(f"K_{n}", 3, [value for row in k for value in row])
            + matrix(f"D_{n}", 5, dist)
            + f"W_{n}: {size[0]}\nH_{n}: {size[1]}\n"
        )
        extri += matrix(f"R_{n}", 3, [0.0, 0.0, 0.0]) + matrix(f"T_{n}", 3, t)
    return {"intri.yml": intri.encode(), "extri.yml": extri.encode()}


def _panoptic(cameras: list[Camera], size: list[int]) -> bytes:
    listed = [
        {"name": str(n), "type": "hd", "resolution": size, "K": k, "distCoef": dist, "R": r, "t": [[v] for v in t]}
        for n, (k, dist, r, t) in enumerate(cameras)
    ]
    return _json({"cameras": listed})


def _toml(cameras: list[Camera], size: list[int], prefix: str) -> bytes:
    tables = [
        f'[{prefix}{n}]\nname = "{n}"\nsize = {size}\nmatrix = {k}\ndistortions = {dist}\nrotation = {r}\n'
        f"translation = {t}\nfisheye = false\n"
        for n, (k, dist, r, t) in enumerate(cameras)
    ]
    return "".join(tables).encode()


def _qualisys(cameras: list[Camera], size: list[int]) -> bytes:
    elements = []
    for n, (k, dist, _, t) in enumerate(cameras):
        turned = " ".join(f'r{i}{j}="{float(i == j)}"' for i in (1, 2, 3) for j in (1, 2, 3))
        elements.append(
            f'<camera serial="{n}"> <transform x="{-1000 * t[0]}" y="0" z="0" {turned}/> '
            f'<intrinsic sensorMaxU="{64 * size[0] - 1}" sensorMaxV="{64 * size[1] - 1}" '
            f'focalLengthU="{64 * k[0][0]}" focalLengthV="{64 * k[1][1]}" centerPointU="{64 * k[0][2]}" '
            f'centerPointV="{64 * k[1][2]}" radialDistortion1="{dist[0]}" radialDistortion2="0" radialDistortion3="0" '
            'tangentalDistortion1="0" tangentalDistortion2="0"/> </camera>\n'
        )
    return f"<calibration> <cameras>\n{''.join(elements)}</cameras> </calibration>".encode()


def _opencv(cameras: list[Camera], size: list[int]) -> bytes:
    own = {
        str(n): {"K": k, "dist": dist, "R": r, "t": t, "image_size": size} for n, (k, dist, r, t) in enumerate(cameras)
    }
    return _json(own)


def _nerfies(cameras: list[Camera], size: list[int], images: dict[str, bytes]) -> dict[str, bytes]:
    files = {f"rgb/1x/{name.removeprefix('images/')}": data for name, data in images.items()}
    for n, (k, dist, r, t) in enumerate(cameras):
        files[f"camera/{n}.json"] = _json(
            {
                "orientation": r,
                "position": [-value for value in t],
                "focal_length": k[0][0],
                "principal_point": [k[0][2] + 0.5, k[1][2] + 0.5],
                "radial_distortion": [dist[0], 0, 0],
                "tangential": [0, 0],
                "image_size": size,
            }
        )
    names = [str(n) for n in range(len(cameras))]
    files["dataset.json"] = _json({"ids": names, "train_ids": names[1:], "val_ids": names[:1]})
    files["metadata.json"] = _json({name: {"warp_id": n, "camera_id": 0} for n, name in enumerate(names)})
    files["scene.json"] = _json({"scale": 0.5, "center": [0, 0, 0], "near": 0.1, "far": 5.0})
    return files
