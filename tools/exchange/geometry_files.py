"""Points and meshes as PLY and GLB files.

PLY holds 8-bit display colours (sRGB), as programs expect; glTF takes vertex colours as linear light, so they are
float32 there.
"""

from pathlib import Path

import numpy as np

from kpc.format.common.cli import atomic_write
from kpc.format.common.images import linear_from_srgb
from kpc.format.common.version import VERSION
from kpc.tools.exchange.gltf import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, GltfWriter
from kpc.tools.exchange.mesh import Mesh
from kpc.tools.exchange.placement import Placement
from kpc.tools.exchange.points import Cloud

SUFFIXES = (".ply", ".glb")
_POINTS, _TRIANGLES = 0, 4


def write_geometry(path: Path, shape: Cloud | Mesh, placement: Placement) -> None:
    """Write points or a mesh, placed, in the format of the suffix of `path`."""
    points = placement.points(shape.points).astype(np.float32)
    normals = None if shape.normals is None else (shape.normals @ placement.rotation.T).astype(np.float32)
    triangles = shape.triangles if isinstance(shape, Mesh) else None
    write = _write_ply if path.suffix.lower() == ".ply" else _write_glb
    write(path, points, shape.colours, normals, triangles)


def _write_ply(
    path: Path, points: np.ndarray, colours: np.ndarray, normals: np.ndarray | None, triangles: np.ndarray | None
) -> None:
    fields = [(axis, "<f4") for axis in "xyz"]
    columns = list(points.T)
    if normals is not None:
        fields += [(f"n{axis}", "<f4") for axis in "xyz"]
        columns += list(normals.T)
    fields += [(name, "u1") for name in ("red", "green", "blue")]
    columns += list(np.round(colours * 255).astype(np.uint8).T)
    vertices = np.empty(len(points), fields)
    for (name, _), column in zip(fields, columns, strict=True):
        vertices[name] = column
    names = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"comment kpexport {VERSION}, y is up"]
    header += [f"element vertex {len(points)}", *(f"property {names[kind]} {name}" for name, kind in fields)]
    body = vertices.tobytes()
    if triangles is not None:
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, triangles
        body += faces.tobytes()
    with atomic_write(path) as aside:
        aside.write_bytes("\n".join([*header, "end_header\n"]).encode("ascii") + body)


def _write_glb(
    path: Path, points: np.ndarray, colours: np.ndarray, normals: np.ndarray | None, triangles: np.ndarray | None
) -> None:
    writer = GltfWriter([{"name": path.stem, "mesh": 0}])
    attributes = {
        "POSITION": writer.add(points, ARRAY_BUFFER),
        "COLOR_0": writer.add(linear_from_srgb(colours).astype(np.float32), ARRAY_BUFFER),
    }
    if normals is not None:
        attributes["NORMAL"] = writer.add(normals, ARRAY_BUFFER)
    primitive = {"attributes": attributes, "mode": _POINTS if triangles is None else _TRIANGLES, "material": 0}
    if triangles is not None:
        primitive["indices"] = writer.add(triangles.astype(np.uint32).ravel(), ELEMENT_ARRAY_BUFFER)
    writer.document["meshes"] = [{"name": path.stem, "primitives": [primitive]}]
    # The colours hold the light already: viewers that know the extension do not light them again.
    writer.document["materials"] = [
        {
            "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
            "extensions": {"KHR_materials_unlit": {}},
        }
    ]
    writer.document["extensionsUsed"] = ["KHR_materials_unlit"]
    writer.write(path)
