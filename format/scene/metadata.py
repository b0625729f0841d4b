"""What a file says of itself: title and author, how to look at the scene, and how it was made.

All of it is optional. A file holds it as a JSON object (spec/kpc-format.md, "meta: metadata"), whose members are
checked by `kpc.format.container.metadata_chunk`; members that this version does not know are kept.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kpc.format.common.text import option_name
from kpc.format.scene.cameras import Camera

HISTORY_LIMIT = 64  # entries of the history; the last ones are kept
# Members whose own members hold for a clip where its parts agree, and words for those whose names are not plain.
PARTLY_AGREED = ("provenance", "options")
WORDS = {
    "cameras": "camera names",
    "transparent": "mark as transparent",
    "held_out": "held-out quality",
    "coding_loss_db": "coding loss",
    "dataset_sha256": "dataset",
}


@dataclass(frozen=True)
class ViewLimits:
    """From where, and how near, a scene holds.

    A position has an azimuth, an elevation and a distance around the focus. Seen from the focus, azimuth 0 is the
    horizontal part of `forward`; it grows towards `cross(up, forward)`, which is to the right of a viewer who looks at
    the focus.

    Attributes:
        focus: (3,) the point that viewers look at, world coordinates.
        forward: (3,) unit vector from the focus to a viewer at azimuth 0.
        up: (3,) unit vector, perpendicular to `forward`.
        azimuth, elevation: least and largest, radians; an azimuth of a full turn has no bounds.
        distance: least and largest, world units.
        reach: how far from the focus the point may lie that a viewer looks at, world units.
    """

    focus: np.ndarray
    forward: np.ndarray
    up: np.ndarray
    azimuth: tuple[float, float]
    elevation: tuple[float, float]
    distance: tuple[float, float]
    reach: float

    def position(self, eye: np.ndarray) -> tuple[float, float, float]:
        """Return the azimuth, nearest to the middle of its limits, the elevation and the distance of a point.

        Args:
            eye: (3,) the point, world coordinates.

        Returns:
            Radians, radians and world units.
        """
        offset = eye - self.focus
        distance = max(float(np.linalg.norm(offset)), 1e-12)
        azimuth = math.atan2(float(offset @ np.cross(self.up, self.forward)), float(offset @ self.forward))
        middle = sum(self.azimuth) / 2
        azimuth = middle + math.remainder(azimuth - middle, 2 * math.pi)
        return azimuth, math.asin(min(max(float(offset @ self.up) / distance, -1.0), 1.0)), distance


@dataclass(frozen=True)
class Opening:
    """What a viewer shows first.

    Attributes:
        camera: the view.
        time: in [0, 1] over the clip.
    """

    camera: Camera
    time: float


@dataclass(frozen=True)
class Metadata:
    """The metadata of a file; see the module.

    Attributes:
        document: the JSON object, as dictionaries, lists, strings, numbers and booleans.
    """

    document: Mapping[str, Any] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.document)

    @property
    def title(self) -> str:
        """The title; empty if there is none."""
        return str(self.document.get("title", ""))

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The names of the scene's cameras, in their order; empty if they are not known."""
        return tuple(self.document.get("camera_names", ()))

    def names_of(self, cameras: int) -> tuple[str, ...]:
        """Return a name for each camera of a rig, their numbers from 0 on where the file does not name them all."""
        names = self.camera_names
        return names if len(names) == cameras else tuple(str(number) for number in range(cameras))

    def camera_number(self, text: str, cameras: int) -> int | None:
        """Return which camera of a rig a user means: the one of that name, or else the one of that number.

        A number is written without leading zeros; "0003" is a name.

        Args:
            text: a name, or a number from 0 on.
            cameras: of the rig.

        Returns:
            The number, which may be too large; None where the text is neither a name nor a number.
        """
        names = self.names_of(cameras)
        if text in names:
            return names.index(text)
        return int(text) if re.fullmatch("0|[1-9][0-9]{0,8}", text) else None

    @property
    def provenance(self) -> Mapping[str, Any]:
        """How the file was made; empty if that is not known."""
        return self.document.get("provenance", {})

    @property
    def up(self) -> np.ndarray | None:
        """The direction that is up in the world, (3,) unit vector; None if it is not known."""
        return _unit(self.document["up"]) if "up" in self.document else None

    @property
    def opening(self) -> Opening | None:
        """What a viewer shows first; None if that is not known.

        Raises:
            DatasetError: the camera cannot be.
        """
        if "opening" not in self.document:
            return None
        opening = self.document["opening"]
        return Opening(camera_from(opening["camera"]), float(opening["time"]))

    @property
    def view_limits(self) -> ViewLimits | None:
        """From where the scene holds; None if that is not known."""
        up = self.up
        if "view_limits" not in self.document or up is None:
            return None
        limits = self.document["view_limits"]
        forward = np.array(limits["forward"], float)
        (azimuth, elevation), (near, far) = np.radians([limits["azimuth"], limits["elevation"]]), limits["distance"]
        return ViewLimits(
            np.array(limits["focus"], float),
            _unit(forward - forward @ up * up),
            up,
            (float(azimuth[0]), float(azimuth[1])),
            (float(elevation[0]), float(elevation[1])),
            (float(near), float(far)),
            float(limits["reach"]),
        )

    def with_members(self, **members: Any) -> "Metadata":
        """Return the metadata with some members of the object replaced, and without those that are None."""
        changed = {**self.document, **members}
        return Metadata({name: value for name, value in changed.items() if value is not None})

    def with_provenance(self, **members: Any) -> "Metadata":
        """Return the metadata with some members of its provenance replaced, and without those that are None."""
        changed = {name: value for name, value in {**self.provenance, **members}.items() if value is not None}
        return self.with_members(provenance=changed or None)


def merged(parts: list[Metadata]) -> Metadata:
    """Return the metadata of a clip that is joined from parts with these.

    They are the members that all parts have and agree on: an author, a licence or a measured quality that some lack
    does not hold for the whole. The opening view is that of the first part, and view limits around one focus become
    those that hold in all parts.
    """
    documents = [part.document for part in parts]
    found = _agreed(documents)
    if parts and "opening" in parts[0].document:
        found["opening"] = parts[0].document["opening"]
    limits = _intersection([document.get("view_limits") for document in documents])
    if limits is not None and "up" in found:
        found["view_limits"] = limits
    elif "view_limits" in found:
        del found["view_limits"]
    return Metadata(found)


def differences(parts: list[Metadata]) -> list[str]:
    """Return, in words, the members of parts that `merged` leaves out because they are not alike in all."""
    return _differing([part.document for part in parts], merged(parts).document)


def _differing(documents: list[Mapping[str, Any]], kept: Mapping[str, Any], are_options: bool = False) -> list[str]:
    found = []
    for name in dict.fromkeys(name for document in documents for name in document):
        if name in PARTLY_AGREED:
            inner = [document.get(name, {}) for document in documents]
            found += _differing(inner, kept.get(name, {}), name == "options")
        elif name not in kept and are_options:
            found.append(option_name(name))
        elif name not in kept:
            found.append(WORDS.get(name, name).replace("_", " "))
    return found


def _intersection(limits: list[dict[str, Any] | None]) -> dict[str, Any] | None:
    """Return the view limits within all others; None if some lack, lie around another focus or exclude others."""
    known = [one for one in limits if one is not None]
    frames = [(one["focus"], one["forward"]) for one in known]
    if not known or len(known) < len(limits) or any(frame != frames[0] for frame in frames):
        return None
    bounds = {
        name: [max(one[name][0] for one in known), min(one[name][1] for one in known)]
        for name in ("azimuth", "elevation", "distance")
    }
    if any(low > high for low, high in bounds.values()):
        return None
    return {**known[0], **bounds, "reach": min(one["reach"] for one in known)}


def _agreed(documents: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the members that all documents have and agree on; of provenance and its options, their members that do."""
    found = {}
    for name in documents[0] if documents else ():
        if not all(name in document for document in documents):
            continue
        values = [document[name] for document in documents]
        if name in PARTLY_AGREED:
            found[name] = _agreed(values)
        elif all(value == values[0] for value in values):
            found[name] = values[0]
    return {name: value for name, value in found.items() if value != {}}


def camera_document(camera: Camera) -> dict[str, Any]:
    """Return a camera as the JSON object of the metadata holds it; numbers have seven digits."""
    return {
        "width": camera.width,
        "height": camera.height,
        "focal": rounded([camera.fl_x, camera.fl_y]),
        "centre": rounded([camera.cx, camera.cy]),
        "pose": rounded(np.ravel(camera.camera_to_world[:3])),
    }


def camera_from(document: Mapping[str, Any]) -> Camera:
    """Return the camera that an object of the metadata describes.

    Raises:
        DatasetError: it cannot be.
    """
    pose = np.vstack([np.reshape(np.array(document["pose"], float), (3, 4)), [0.0, 0.0, 0.0, 1.0]])
    (fl_x, fl_y), (cx, cy) = document["focal"], document["centre"]
    width, height = int(document["width"]), int(document["height"])
    return Camera(width, height, float(fl_x), float(fl_y), float(cx), float(cy), pose)


def limits_document(limits: ViewLimits) -> dict[str, Any]:
    """Return view limits as the JSON object of the metadata holds them; `up` is a member of its own there."""
    return {
        "focus": rounded(limits.focus),
        "forward": rounded(limits.forward),
        "azimuth": rounded(np.degrees(limits.azimuth)),
        "elevation": rounded(np.degrees(limits.elevation)),
        "distance": rounded(limits.distance),
        "reach": rounded([limits.reach])[0],
    }


def rounded(numbers: "Any") -> list[float]:
    """Return numbers rounded to seven significant digits, whole ones as integers."""
    found = (float(f"{float(number):.7g}") for number in numbers)
    return [int(number) if number.is_integer() and abs(number) < 1e15 else number for number in found]


def _unit(vector: Any) -> np.ndarray:
    array = np.array(vector, float)
    return np.asarray(array / np.linalg.norm(array))
