"""glTF 2.0 documents: JSON, and arrays in one buffer. Written as text (.gltf) or binary (.glb), and read back.

Libraries read and write meshes, but not what is needed here: animated cameras, vertex colours of more than eight bits
(glTF takes them as linear light), and the reading of files from anywhere, with checks.
"""

import base64
import binascii
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kpc.format.common.cli import atomic_write
from kpc.format.common.errors import DatasetError
from kpc.format.common.version import VERSION

MAX_FILE_BYTES = 1 << 28
FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
KINDS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_DATA_URIS = ("data:application/octet-stream;base64,", "data:application/gltf-buffer;base64,")


class GltfWriter:
    """A document in the making.

    Attributes:
        document: the JSON object; the writer fills in its accessors and the buffer.
    """

    def __init__(self, nodes: list[dict[str, Any]], **members: Any) -> None:
        """Begin a document with these nodes, all of them roots of its scene, and other members."""
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": f"kpexport {VERSION}"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(nodes)))}],
            "nodes": nodes,
            **members,
        }
        self._parts: list[bytes] = []

    def add(self, array: np.ndarray, target: int | None = None) -> int:
        """Add an array, (N,) or (N, K) of float32 or uint32, with its bounds, and return the number of its accessor."""
        assert array.dtype in (np.float32, np.uint32)
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": sum(map(len, self._parts)),
            "byteLength": array.nbytes,
        }
        if target is not None:
            view["target"] = target
        self._parts.append(np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes())
        views, accessors = (self.document.setdefault(name, []) for name in ("bufferViews", "accessors"))
        views.append(view)
        width = 1 if array.ndim == 1 else array.shape[1]
        columns = array.reshape(len(array), width)
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": FLOAT if array.dtype == np.float32 else UNSIGNED_INT,
                "count": len(array),
                "type": next(name for name, size in KINDS.items() if size == width),
                "min": columns.min(0).tolist(),
                "max": columns.max(0).tolist(),
            }
        )
        return len(accessors) - 1

    def write(self, path: Path) -> None:
        """Write the document: in one binary file for .glb, else as text with the buffer in it."""
        buffer = b"".join(self._parts)
        is_binary = path.suffix.lower() == ".glb"
        if buffer:
            uri = {} if is_binary else {"uri": _DATA_URIS[0] + base64.b64encode(buffer).decode("ascii")}
            self.document["buffers"] = [{"byteLength": len(buffer), **uri}]
        with atomic_write(path) as aside:
            if not is_binary:
                aside.write_text(json.dumps(self.document, indent=1), encoding="utf-8")
                return
            text = json.dumps(self.document).encode("utf-8")
            text += b" " * (-len(text) % 4)
            chunks = struct.pack("<II", len(text), _JSON) + text
            if buffer:
                chunks += struct.pack("<II", len(buffer), _BIN) + buffer
            aside.write_bytes(struct.pack("<III", _MAGIC, 2, 12 + len(chunks)) + chunks)


class GltfReader:
    """A document that was read; what it holds is checked where it is used.

    Attributes:
        where: the file, which begins messages.
        document: the JSON object.
    """

    def __init__(self, path: Path) -> None:
        """Read a .gltf or .glb file.

        Raises:
            DatasetError: it is too large, or no glTF 2.0.
        """
        self.where = str(path)
        self._folder, self._buffers = path.parent, dict[int, bytes]()
        content = self._read(path)
        text = content
        if content[:4] == struct.pack("<I", _MAGIC):
            text = self._chunks(content)
        try:
            document = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise DatasetError(f"{path}: not glTF ({error}); export it anew") from error
        asset = document.get("asset") if isinstance(document, dict) else None
        version = asset.get("version") if isinstance(asset, dict) else None
        if not (isinstance(version, str) and version.startswith("2.")):
            raise DatasetError(f"{path}: not glTF 2.0; export it anew")
        self.document: Mapping[str, Any] = document

    def objects(self, *names: str) -> list[Mapping[str, Any]]:
        """Return a list of objects of the document, such as "nodes" or "extensions", "KHR_lights"; empty if absent.

        Raises:
            DatasetError: it is something else.
        """
        found: Any = self.document
        for name in names:
            found = found.get(name, {} if name != names[-1] else []) if isinstance(found, Mapping) else None
        if not isinstance(found, list) or not all(isinstance(one, Mapping) for one in found):
            raise self.error(f"{names[-1]} is not a list of objects")
        return found

    def entry(self, name: str, number: Any) -> Mapping[str, Any]:
        """Return object `number` of a list of the document.

        Raises:
            DatasetError: there is none.
        """
        listed = self.objects(name)
        if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < len(listed):
            raise self.error(f"{name} has no entry {str(number)[:40]}")
        return listed[number]

    def floats(self, number: Any, kind: str) -> np.ndarray:
        """Return the float32 array of an accessor as float64: (N,) for "SCALAR", else (N, K).

        Raises:
            DatasetError: it is another array, or lies outside its buffer.
        """
        accessor = self.entry("accessors", number)
        if accessor.get("componentType") != FLOAT or accessor.get("type") != kind or "sparse" in accessor:
            raise self.error(f"accessor {number} is not a plain float32 {kind}")
        view = self.entry("bufferViews", accessor.get("bufferView"))
        width, count = KINDS[kind], self._whole(accessor, "count")
        stride = self._whole(view, "byteStride", 4 * width)
        start = self._whole(view, "byteOffset", 0) + self._whole(accessor, "byteOffset", 0)
        data = self._buffer(view.get("buffer"))
        if count < 1 or stride < 4 * width or start + (count - 1) * stride + 4 * width > len(data):
            raise self.error(f"accessor {number} lies outside its buffer")
        rows = np.ndarray((count, width), "<f4", data, start, (stride, 4)).astype(np.float64)
        return rows[:, 0] if kind == "SCALAR" else rows

    def error(self, reason: str) -> DatasetError:
        """Return the error that refuses the file for a reason."""
        return DatasetError(f"{self.where}: {reason}; export it anew")

    def _whole(self, keys: Mapping[str, Any], name: str, default: int | None = None) -> int:
        value = keys.get(name, default)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MAX_FILE_BYTES:
            raise self.error(f"{name} is {str(value)[:40]}, not a number of bytes or entries")
        return value

    def _buffer(self, number: Any) -> bytes:
        buffer = self.entry("buffers", number)
        if number not in self._buffers:
            uri = buffer.get("uri")
            prefix = next((p for p in _DATA_URIS if isinstance(uri, str) and uri.startswith(p)), None)
            if prefix is not None:
                try:
                    self._buffers[number] = base64.b64decode(str(uri)[len(prefix) :], validate=True)
                except binascii.Error as error:
                    raise self.error(f"buffer {number} is not base64") from error
            elif not isinstance(uri, str) or Path(uri).name != uri or ":" in uri or "\\" in uri:
                raise self.error(f"buffer {number} is no plain file beside it")
            else:
                self._buffers[number] = self._read(self._folder / uri)
        return self._buffers[number]

    def _chunks(self, content: bytes) -> bytes:
        """Return the JSON of a binary file, and keep its buffer."""
        chunks: dict[int, bytes] = {}
        at = 12
        while at + 8 <= len(content):
            size, kind = struct.unpack_from("<II", content, at)
            if at + 8 + size > len(content):
                raise self.error("a chunk is cut off")
            chunks.setdefault(kind, content[at + 8 : at + 8 + size])
            at += 8 + size
        if _JSON not in chunks:
            raise self.error("has no JSON chunk")
        if _BIN in chunks:
            self._buffers[0] = chunks[_BIN]
        return chunks[_JSON]

    def _read(self, path: Path) -> bytes:
        if path.exists() and not path.is_file():
            raise DatasetError(f"{path}: not a regular file; copy it to one")
        with open(path, "rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
        if len(content) > MAX_FILE_BYTES:
            raise DatasetError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB; export the cameras alone")
        return content
