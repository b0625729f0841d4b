"""Which way is up by gravity: what phones and drones write about it beside a photograph, and what follows from many.

Tags are data of unknown origin: whatever cannot be read, or makes no sense, is no tag.
"""

import os
import re
import struct
from typing import NamedTuple

import numpy as np

from kpc.format.common.images import CameraTags, camera_tags

# The head of Apple's MakerNote, whose directory (IFD) follows in big-endian order, its entry of the acceleration, and
# EXIF's number of the type SRATIONAL.
APPLE, ACCELERATION, SRATIONAL = b"Apple iOS\0\0\x01MM", 8, 10
# A phone that is held still feels so much of g, at least and at most.
LEAST_G, MOST_G = 0.8, 1.2
# Names in XMP of pitch and roll in degrees, of DJI's gimbals and of Google's panoramas.
ANGLES = (
    (b"drone-dji:GimbalPitchDegree", b"drone-dji:GimbalRollDegree"),
    (b"GPano:PosePitchDegrees", b"GPano:PoseRollDegrees"),
)
VALUE = rb"""\s*(?:=\s*["']|>)\s*([+-]?\d{1,3}(?:\.\d{0,12})?)\s*["'<]"""
# Tags agree if at least so many, and this share of them, are within so many degrees of their median.
LEAST_TAGS, AGREEING, WITHIN_DEGREES = 3, 2 / 3, 10.0


class Agreed(NamedTuple):
    """What most tags agree on.

    Attributes:
        up: (3,) unit vector in the world.
        agreeing: number of tags that do.
    """

    up: np.ndarray
    agreeing: int


def tagged_up(path: str | os.PathLike[str]) -> np.ndarray | None:
    """Return what is up in the camera of a picture as shown: a unit vector (3,), OpenGL convention.

    Return None if the picture has no usable tag. Tags of gravity are the acceleration in Apple's MakerNote, and pitch
    and roll in the XMP of DJI's drones or of Google's panorama namespace.

    Raises:
        MediaError: as `read_image`.
    """
    return up_of_tags(camera_tags(path))


def up_of_tags(tags: CameraTags) -> np.ndarray | None:
    """Return what `tagged_up` does of the tags of a picture."""
    acceleration = apple_acceleration(tags.maker_note)
    if acceleration is not None and "front" not in tags.lens:  # front cameras look the other way
        return _up_of_phone(acceleration, tags.orientation)
    angles = _angles(tags.xmp)
    # The angles are those of the picture as stored, which drones store upright.
    return _up_of_angles(*angles) if angles is not None and tags.orientation == 1 else None


def apple_acceleration(note: bytes) -> np.ndarray | None:
    """Return AccelerationVector of Apple's MakerNote, (3,) in g; None if it is missing, damaged, or not about 1 g.

    The axes are those of Apple's Core Motion, seen from the front of an upright phone: right, up, and out of the
    screen. At rest the vector points down, and is (0, -1, 0) in an upright phone. ExifTool, whose list of Apple's tags
    names the entry, reverses the axes and has it point up, which is the same. Offsets count from the note's start.
    """
    if not note.startswith(APPLE):
        return None
    try:
        (count,) = struct.unpack_from(">H", note, len(APPLE))
        for number in range(count):
            tag, kind, size, where = struct.unpack_from(">HHII", note, len(APPLE) + 2 + 12 * number)
            if (tag, kind, size) == (ACCELERATION, SRATIONAL, 3):
                fractions = np.array(struct.unpack_from(">6i", note, where), float).reshape(3, 2)
                break
        else:
            return None
    except struct.error:  # the note is cut off, or an offset lies outside
        return None
    if not fractions[:, 1].all():
        return None
    found = fractions[:, 0] / fractions[:, 1]
    return found if LEAST_G <= np.linalg.norm(found) <= MOST_G else None


def _up_of_phone(acceleration: np.ndarray, orientation: int) -> np.ndarray:
    """Return what is up in the back camera of a phone, in the picture as shown.

    As stored, a picture is upright if the phone lies on its left side: the picture's right is then the phone's bottom,
    and the picture's top is the phone's right side. So up is (a_y, -a_x, -a_z) / |a|, which the EXIF orientation turns.
    Tags in public listings agree: a_z is positive of a rocket in the sky, and negative of things within a metre.
    Programs that turn the pixels, as decoders of HEIC do, call the result orientation 1 whatever it was. Phones show
    pictures upright, so that orientation 1 stands for that quarter turn which puts up nearest to the top.
    """
    x, y, back = np.array([acceleration[1], -acceleration[0], -acceleration[2]]) / np.linalg.norm(acceleration)
    if orientation == 1:
        x, y = max(((x, y), (y, -x), (-x, -y), (-y, x)), key=lambda turned: turned[1])
    if orientation >= 5:
        x, y = -y, -x
    if orientation in (2, 3, 6, 7):
        x = -x
    if orientation in (3, 4, 7, 8):
        y = -y
    return np.array([x, y, back])


def _angles(xmp: bytes) -> tuple[float, float] | None:
    """Return pitch and roll in degrees, whether they are attributes or elements of XMP; None without both."""
    for names in ANGLES:
        found = [re.search(name + VALUE, xmp) for name in names]
        pitch, roll = (180.1 if one is None else float(one[1]) for one in found)
        if max(abs(pitch), abs(roll)) <= 180:
            return pitch, roll
    return None


def _up_of_angles(pitch: float, roll: float) -> np.ndarray:
    """Return what is up in a camera of some pitch and roll, degrees: (-sin r cos p, cos r cos p, -sin p).

    Pitch is the angle of the optical axis above the horizon, and roll is positive if the right side is lower: both are
    rotations in a frame with axes north, east and down in the order yaw, pitch, roll, as DJI's manuals say of gimbals.
    Google's specification of photo spheres has the same signs: the horizon turns counterclockwise as roll increases.
    """
    p, r = np.radians([pitch, roll])
    return np.array([-np.sin(r) * np.cos(p), np.cos(r) * np.cos(p), -np.sin(p)])


def agreed_up(votes: np.ndarray) -> Agreed | None:
    """Return the mean of those votes that are near the median of all; None if they are few, or too few agree.

    Args:
        votes: (N, 3) unit vectors in the world, what each tag calls up.
    """
    if len(votes) < LEAST_TAGS:
        return None
    middle = np.median(votes, axis=0)
    near = votes @ middle > np.cos(np.radians(WITHIN_DEGREES)) * np.linalg.norm(middle)
    if near.mean() < AGREEING:
        return None
    mean = votes[near].mean(0)
    return Agreed(mean / np.linalg.norm(mean), int(near.sum()))
