"""From where a scene holds: view limits and an opening view, found by rendering depths from the scene's cameras.

A picture holds where what it shows was seen by at least two cameras. A camera sees a point if the point lies in its
picture and not behind what the camera sees there. Rays that meet nothing show what was filmed only if the cameras see
through the scene, too, as they see past an object before a plain background; in a room they show what nobody filmed.

The limits are a range of azimuths, elevations and distances around the point that the cameras look at, which grows
from the first camera as long as its borders hold.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kpc.format.common.progress import Progress
from kpc.format.scene.cameras import Camera
from kpc.format.scene.metadata import Opening, ViewLimits, camera_document, limits_document, rounded
from kpc.format.scene.rig import Rig, surround_focus
from kpc.format.scene.scene import Scene

# Renders a camera: depths along its rays in world units and opacities, both (height * width,), row by row.
Look = Callable[[Camera], tuple[np.ndarray, np.ndarray]]

# Cameras that are asked what they see, and the width of their depths and of the pictures that are judged, pixels.
MOST_CAMERAS, SEEN_WIDTH, JUDGED_WIDTH = 16, 40, 20
# A camera sees a point up to so much farther than what it sees in the direction of that point, as a share of distance.
DEPTH_TOLERANCE = 0.1
USUAL_VIEWS = 130  # that are rendered where cameras stand on one side of a scene
# A pixel is opaque from this opacity on. Cameras see through the scene if more than this share of their pixels is not.
OPAQUE, SEEN_THROUGH = 0.5, 0.02
# The share of pixels that must hold, at most, and how far it may fall below that of the median camera.
WANTED_SHARE, SPARE_SHARE = 0.98, 0.02
# The share of pixels of the opening view that must hold, and the focal lengths to try over that of the first camera.
OPENING_SHARE, OPENING_ZOOMS = 0.995, (1.0, 1.06, 1.12, 1.2, 1.3, 1.4, 1.5)
# The opening view is judged in this shape, width over height, or that of its camera if that is wider.
OPENING_ASPECT = 16 / 9
# Steps in which angles grow, how far they may leave those of the cameras, and the largest elevation, radians. Colours
# that depend on the direction are wrong far from all cameras.
STEP, BEYOND_CAMERAS, MOST_ELEVATION = math.radians(5), math.radians(20), math.radians(85)
# Distances to try, over the least and the largest of the cameras: nearer than half, pictures are blurred.
NEARER, FARTHER = (0.9, 0.8, 0.7, 0.6, 0.5), (1.15, 1.3, 1.5, 1.75, 2.0)
# How far the point that is looked at may move, in heights of the picture.
REACHES = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)


@dataclass(frozen=True)
class _Sight:
    """What one camera sees: depths of its pixels, (height, width), infinite where it meets nothing."""

    camera: Camera
    depth: np.ndarray

    def sees(self, points: np.ndarray) -> np.ndarray:
        """Return whether the camera sees points, (N, 3) to (N,) bool."""
        c = self.camera
        offsets = points - c.camera_to_world[:3, 3]
        local, distance = offsets @ c.camera_to_world[:3, :3], np.linalg.norm(offsets, axis=1)
        ahead = local[:, 2] < -1e-9
        z = np.where(ahead, -local[:, 2], 1.0)
        i, j = c.cx + c.fl_x * local[:, 0] / z, c.cy - c.fl_y * local[:, 1] / z
        inside = ahead & (i >= 0) & (i < c.width) & (j >= 0) & (j < c.height)
        column, row = (np.where(inside, a, 0).astype(int) for a in (i, j))
        return np.asarray(inside & (distance <= (1 + DEPTH_TOLERANCE) * self.depth[row, column]))


class _Judge:
    """Says which share of a picture was seen by at least two cameras of a scene."""

    def __init__(self, cameras: Sequence[Camera], look: Look) -> None:
        self._look, self._sights = look, []
        self._sees_through = False
        chosen = np.unique(np.linspace(0, len(cameras) - 1, MOST_CAMERAS).round().astype(int))
        clear = []
        for camera in (_shrunk(cameras[number], SEEN_WIDTH) for number in chosen):
            depth, opacity = look(camera)
            depth = np.where(opacity >= OPAQUE, depth, np.inf).reshape(camera.height, camera.width)
            # A point on an edge is seen if it is as near as the farthest of the pixels around it.
            padded = np.pad(depth, 1, mode="edge")
            around = [padded[y : y + camera.height, x : x + camera.width] for y in range(3) for x in range(3)]
            self._sights.append(_Sight(camera, np.max(around, axis=0)))
            clear.append(np.mean(opacity < OPAQUE))
        self._sees_through = bool(np.mean(clear) > SEEN_THROUGH)
        self.wanted = min(WANTED_SHARE, float(np.median([self.share(c) for c in cameras[:MOST_CAMERAS]])) - SPARE_SHARE)

    def share(self, camera: Camera) -> float:
        """Return the share of the pixels of a camera that hold."""
        small = _shrunk(camera, JUDGED_WIDTH)
        depth, opacity = self._look(small)
        origins, directions = small.rays()
        opaque = opacity >= OPAQUE
        points = origins + np.where(opaque, depth, 0.0)[:, None] * directions
        seen = np.sum([sight.sees(points) for sight in self._sights], axis=0) >= 2
        return float(np.mean(np.where(opaque, seen, self._sees_through)))


def find_view(scene: Scene, look: Look) -> tuple[Opening | None, ViewLimits | None]:
    """Return an opening view without pixels that nobody filmed, and limits; None where too few cameras are known.

    Args:
        scene: with its cameras.
        look: renders the scene at some time.
    """
    rig = Rig.of(scene)
    eyes = np.array([camera.camera_to_world[:3, 3] for camera in scene.cameras])
    ahead = [(rig.focus - camera.camera_to_world[:3, 3]) @ -camera.camera_to_world[:3, 2] for camera in scene.cameras]
    if len(eyes) < 3 or np.mean(np.array(ahead) > 0) < 0.9:  # cameras that look outwards have no focus
        return None, None
    with Progress("finding the opening view and limits", USUAL_VIEWS, "views") as bar:

        def counted(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
            bar.extend(1)
            seen = look(camera)
            bar.advance()
            return seen

        judge = _Judge(scene.cameras, counted)
        opening = _opening_camera(scene.cameras[0], judge)
        return Opening(opening, 0.0), _find_limits(replace(rig, cameras=(opening, *rig.cameras[1:])), judge)


def view_members(scene: Scene, opening: Opening | None, limits: ViewLimits | None) -> dict[str, Any]:
    """Return what `find_view` found as members of the metadata, and up, which the cameras of the scene say."""
    members: dict[str, Any] = {}
    if opening is not None:
        members["opening"] = {"camera": camera_document(opening.camera), "time": opening.time}
    if limits is not None:
        members["view_limits"] = limits_document(limits)
    if len(scene.cameras) > 1:
        members["up"] = rounded(np.round(Rig.of(scene).up, 4))
    return members


def _opening_camera(camera: Camera, judge: _Judge) -> Camera:
    """Return the camera with a focal length at which everything holds, also in a wide window."""
    width = max(camera.width, round(OPENING_ASPECT * camera.height))
    wide = replace(camera, width=width, cx=width / 2 + camera.cx - camera.width / 2)
    shares = []
    for zoom in OPENING_ZOOMS:
        shares.append(judge.share(replace(wide, fl_x=wide.fl_x * zoom, fl_y=wide.fl_y * zoom)))
        if shares[-1] >= OPENING_SHARE:
            break
    zoom = OPENING_ZOOMS[int(np.argmax(shares))]
    return replace(camera, fl_x=camera.fl_x * zoom, fl_y=camera.fl_y * zoom)


def _find_limits(rig: Rig, judge: _Judge) -> ViewLimits | None:
    """Return the limits that grow from the first camera; None if it does not hold itself."""
    azimuths, elevations, distances = rig.angles()
    start, distance = (0.0, float(elevations[0])), float(np.median(distances))

    def holds(azimuth: float, elevation: float, distance: float, moved: tuple[float, float] = (0.0, 0.0)) -> bool:
        camera = rig.camera(azimuth, elevation, distance)
        pose = camera.camera_to_world.copy()
        height = distance * camera.height / camera.fl_y
        pose[:3, 3] += height * (moved[0] * pose[:3, 0] + moved[1] * pose[:3, 1])
        return judge.share(replace(camera, camera_to_world=pose)) >= judge.wanted

    if not holds(*start, distance):
        return None
    angles = np.stack([azimuths, elevations], axis=1)
    least, most = angles.min(0) - BEYOND_CAMERAS, angles.max(0) + BEYOND_CAMERAS
    if surround_focus(azimuths):
        least[0], most[0] = -math.inf, math.inf
    least[1], most[1] = max(least[1], -MOST_ELEVATION), min(most[1], MOST_ELEVATION)

    def may_be(azimuth: float, elevation: float) -> bool:
        within = least[0] <= azimuth <= most[0] and least[1] <= elevation <= most[1]
        return bool(within) and holds(azimuth, elevation, distance)

    azimuth, elevation = _grown(start, may_be)
    inner = [((start[0] + a) / 2, (start[1] + e) / 2) for a in azimuth for e in elevation]  # borders hold just so
    near, far = float(distances.min()), float(distances.max())
    nearer = _last_holding(NEARER, lambda factor: all(holds(a, e, factor * near) for a, e in inner))
    farther = _last_holding(FARTHER, lambda factor: all(holds(a, e, factor * far) for a, e in inner))
    ways = ((1, 0), (-1, 0), (0, 1), (0, -1))
    reach = _last_holding(REACHES, lambda r: all(holds(*start, distance, (r * x, r * y)) for x, y in ways), 0.0)
    ahead, _ = rig.compass()
    lens = rig.cameras[0]
    return ViewLimits(
        rig.focus,
        ahead,
        rig.up,
        azimuth,
        elevation,
        (nearer * near, farther * far),
        reach * distance * lens.height / lens.fl_y,
    )


def _grown(
    start: tuple[float, float], holds: Callable[[float, float], bool]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Grow a rectangle of azimuths and elevations from a point, a step at a time on each side whose new border holds.

    Returns:
        The least and largest azimuth, and the least and largest elevation.
    """
    bounds = np.array([start, start])  # least and largest of both angles
    open_sides = [(side, axis) for axis in (0, 1) for side in (0, 1)]
    while open_sides:
        for side, axis in list(open_sides):
            wider = bounds.copy()
            wider[side, axis] += STEP if side else -STEP
            low, high = wider[:, 1 - axis]
            along = np.linspace(low, high, max(2, min(5, 1 + round((high - low) / STEP))))
            border = [(wider[side, axis], a) if axis == 0 else (a, wider[side, axis]) for a in along]
            if wider[1, 0] - wider[0, 0] > 2 * math.pi or not all(holds(float(a), float(e)) for a, e in border):
                open_sides.remove((side, axis))
            else:
                bounds = wider
    (azimuth_from, elevation_from), (azimuth_to, elevation_to) = bounds.tolist()
    if azimuth_to - azimuth_from > 2 * math.pi - 2 * STEP:
        azimuth_from, azimuth_to = -math.pi, math.pi
    return (azimuth_from, azimuth_to), (elevation_from, elevation_to)


def _last_holding(factors: Sequence[float], holds: Callable[[float], bool], first: float = 1.0) -> float:
    """Return the last of the factors up to which all hold; `first` if none does."""
    for factor in factors:
        if not holds(factor):
            break
        first = factor
    return first


def _shrunk(camera: Camera, width: int) -> Camera:
    return camera.resized(width, max(1, round(width * camera.height / camera.width)))
