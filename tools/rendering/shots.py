"""The frames to render: which cameras, which times, and what they are called.

Time is continuous: frame n of a film is at n / fps seconds, whatever the rate of the clip. A frame of a clip lasts 1 /
(its rate), the last one, too; so a clip of 30 frames at 30 fps fills one second at any rate.
"""

import argparse
import functools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kpc.format.common import cli
from kpc.format.common.errors import UsageError
from kpc.format.common.text import first_names
from kpc.format.scene.cameras import Camera, View, load_views
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Clip, Scene
from kpc.format.scene.space import FARTHEST_CAMERA, edges_away
from kpc.player.app.camera_paths import CameraPath
from kpc.player.viewpoints import fit_camera, orbit
from kpc.tools.rendering.outputs import plain_name

# Limits of --fps, of the number of pictures, and of the frames of a clip among which they are chosen.
MIN_FPS, MAX_FPS = 0.001, 240.0
MAX_PICTURES = 100_000
MOST_FRAMES = 1e9
# Instants at which a frame with an open shutter is rendered.
SHUTTER_INSTANTS = 8
# Frames by which a time may miss a frame and still mean it: rounding of seconds that were typed.
SLACK = 1e-3


@dataclass(frozen=True)
class Timeline:
    """All frames that cameras and clip give, of which a range is rendered.

    Attributes:
        count: number of frames.
        fps: frames per second.
        at: the camera and the clip's time in [0, 1] at a frame, which need not be whole.
        names: of the frames; None to name them by their numbers.
        is_stopped: whether --time stops the clip.
    """

    count: int
    fps: float
    at: Callable[[float], tuple[Camera, float]]
    names: tuple[str, ...] | None = None
    is_stopped: bool = False


class RigCamera(NamedTuple):
    """A camera that sees every frame, with its name, and the name that its files begin with."""

    name: str
    file_name: str
    camera: Camera


@dataclass(frozen=True)
class Shots:
    """The pictures to render: one of each frame, or one of each frame by each camera of a rig, camera by camera.

    Attributes:
        timeline: all frames.
        frames: the numbers of those to render.
        fps: frames per second of a film of them, which plays as fast as the clip.
        shutter: the part of a frame's time for which the shutter is open, 0 for an instant.
        rig: the cameras that see every frame; none where the timeline has the camera of each.
    """

    timeline: Timeline
    frames: range
    fps: float
    shutter: float
    rig: tuple[RigCamera, ...] = ()

    def __len__(self) -> int:
        return len(self.frames) * max(len(self.rig), 1)

    @property
    def numbers(self) -> range:
        """The numbers of the pictures, by which the other members know them."""
        return range(len(self)) if self.rig else self.frames

    def name(self, number: int) -> str:
        """Return what a picture is called."""
        frame, seen_by = self._parts(number)
        name = f"{frame:04d}" if self.timeline.names is None else self.timeline.names[frame]
        return name if seen_by is None else f"{seen_by.file_name}_{name}"

    def camera(self, number: int) -> Camera:
        """Return the camera of a picture."""
        return self._at(number)[0]

    def camera_name(self, number: int) -> str | None:
        """Return which camera of the rig sees a picture; None where there is none."""
        seen_by = self._parts(number)[1]
        return None if seen_by is None else seen_by.name

    def time(self, number: int) -> float:
        """Return the clip's time of a picture, in [0, 1]."""
        return self._at(number)[1]

    def place(self, number: int) -> float:
        """Return the time of a picture, which is 0 in the first and 1 in the last of the frames that are rendered."""
        return self.frames.index(self._parts(number)[0]) / max(len(self.frames) - 1, 1)

    def instants(self, number: int) -> list[tuple[Camera, float]]:
        """Return the cameras and times whose mean a picture is: one, or several evenly over the time that the shutter
        is open, the middle of which is the frame's."""
        if self.shutter == 0:
            return [self._at(number)]
        steps = (np.arange(SHUTTER_INSTANTS) + 0.5) / SHUTTER_INSTANTS - 0.5
        return [self._at(number, self.shutter * float(step)) for step in steps]

    def times(self) -> Iterator[float]:
        """Yield the clip's times of all instants of all pictures."""
        return (time for number in self.numbers for _, time in self.instants(number))

    def _parts(self, number: int) -> tuple[int, RigCamera | None]:
        """Return the frame of a picture, and which camera of the rig sees it."""
        if not self.rig:
            return number, None
        camera, frame = divmod(number, len(self.frames))
        return self.frames[frame], self.rig[camera]

    def _at(self, number: int, later: float = 0.0) -> tuple[Camera, float]:
        """Return the camera and the clip's time of a picture, or of so many frames later."""
        frame, seen_by = self._parts(number)
        camera, time = self.timeline.at(frame + later)
        return (camera if seen_by is None else seen_by.camera), time


def shots_of(scene: Scene, clip: Clip, options: argparse.Namespace, is_film: bool) -> Shots:
    """Return the frames that the options of `kpc.tools.rendering.options` ask for.

    Raises:
        DatasetError: a camera file cannot be used.
        UsageError: there are no such frames, or too many.
    """
    is_still = options.time is not None and options.cameras is options.path is options.orbit is None
    _check_rate_and_step(options, is_still, is_film)
    timeline = replace(_timeline(scene, clip, options, is_film), is_stopped=options.time is not None)
    has_span = options.frames not in (None, (0, 0)) or options.start_s is not None or options.end_s is not None
    if is_still and has_span:
        raise UsageError(
            "--time stops the clip, so that there is one frame only; leave out --time, or --frames, --from and --to"
        )
    first, last, fps = 0, timeline.count - 1, timeline.fps
    if options.frames is not None:
        if options.start_s is not None or options.end_s is not None:
            raise UsageError("--frames chooses frames, --from and --to seconds; give only one of both")
        first, last = options.frames
        if last >= timeline.count:
            asked = f"{first}-{last}" if last > first else f"{first}"
            raise UsageError(f"--frames {asked}: the last frame is {timeline.count - 1}")
    if options.start_s is not None or options.end_s is not None:
        start_s, end_s = options.start_s or 0.0, options.end_s
        if end_s is not None and end_s > timeline.count / fps + cli.TIME_SLACK_S:
            raise UsageError(f"--to {end_s:g}s: the last frame ends at {timeline.count / fps:.2f} s")
        first = math.ceil(start_s * fps - SLACK)
        if first > last:
            raise UsageError(f"--from {start_s:g}s: the last frame is at {last / fps:.2f} s")
        last = last if end_s is None else min(last, math.ceil(end_s * fps - SLACK) - 1)
        if first > last:
            raise UsageError(f"--from {start_s:g}s --to {end_s:g}s: no frame lies between them; swap or widen them")
    frames, rig = range(first, last + 1, options.step), _rig(scene, options) if options.every_camera else ()
    shots = Shots(timeline, frames, fps / options.step, options.shutter, rig)
    if len(frames) * max(len(rig), 1) > MAX_PICTURES:
        by_each = f" by {len(rig)} cameras" if rig else ""
        raise UsageError(
            f"{len(frames):,} frames{by_each} are more than {MAX_PICTURES:,} pictures; choose fewer by --frames, "
            "--from and --to, a larger --step, or a lower --fps"
        )
    return shots


def _check_rate_and_step(options: argparse.Namespace, is_still: bool, is_film: bool) -> None:
    """Refuse --fps and --step where they change nothing.

    The rate counts for films, an open shutter, paths, seconds, and the frames of a clip that plays.

    Args:
        options: of the command line.
        is_still: whether there is one frame only, of a fixed camera at --time.
        is_film: whether a film is rendered.

    Raises:
        UsageError: one of them changes nothing.
    """
    if is_still and options.step > 1:
        raise UsageError("--time stops the clip, so that there is one frame only; leave out --time or --step")
    has_seconds = options.start_s is not None or options.end_s is not None
    if options.fps is None or is_film or options.shutter > 0 or options.path is not None or has_seconds:
        return
    if is_still:
        raise UsageError("--time stops the clip, so that there is one frame only; leave out --time or --fps")
    if options.cameras is not None or options.orbit is not None:
        name = "--orbit" if options.cameras is None else "--cameras"
        raise UsageError(f"--fps: {name} says how many pictures there are; leave --fps out, or render a film")


def rate_of(clip: Clip) -> float:
    """Return the frames per second without --fps: those of the clip within the limits of --fps; 1 or more of a static
    scene, whose rate means nothing."""
    return min(max(clip.fps, MIN_FPS if clip.frame_count > 1 else 1.0), MAX_FPS)


def rate_note(clip: Clip, options: argparse.Namespace) -> str | None:
    """Return a line for the user where the clip's own rate is beyond the limits of --fps; None where it is used."""
    if options.fps is not None or clip.frame_count == 1 or rate_of(clip) == clip.fps:
        return None
    return f"the clip's {clip.fps:g} fps are beyond {MIN_FPS:g} to {MAX_FPS:g}; {rate_of(clip):g} fps are used"


def _timeline(scene: Scene, clip: Clip, options: argparse.Namespace, is_film: bool) -> Timeline:
    fps = float(options.fps or rate_of(clip))
    # What a frame adds to the clip's time, as a fraction: exact where the rate is the clip's.
    clip_frames, last_frame = clip.fps / fps, max(clip.frame_count - 1, 1)
    fixed_time: float | None = options.time

    fitted = functools.partial(_fitted, scene, options)

    if options.path is not None:
        path = CameraPath.load(options.path)
        duration_s = path.end_s - path.start_s

        def along(frame: float) -> tuple[Camera, float]:
            camera, time = path.at(path.start_s + frame / fps)
            return fitted(camera), time if fixed_time is None else fixed_time

        return Timeline(int(duration_s * fps + 1e-6) + 1, fps, along)

    if options.cameras is not None or options.orbit is not None:
        views = load_views(options.cameras) if options.cameras is not None else _orbit(scene, options)
        if options.size is None and is_film:  # all frames of a film have one size
            first = views[0].camera
            views = [View(fit_camera(v.camera, first.width, first.height), v.time, v.file) for v in views]

        def nearest(frame: float) -> tuple[Camera, float]:
            number = min(max(round(frame), 0), len(views) - 1)
            time = views[number].time if fixed_time is None else fixed_time
            return fitted(views[number].camera), _clamped(time + (frame - number) * clip_frames / last_frame)

        names = tuple(view.file for view in views) if options.cameras is not None else None
        return Timeline(len(views), fps, nearest, names)

    camera = fitted(_camera(scene, options))
    if fixed_time is not None:
        return Timeline(1, fps, lambda frame: (camera, _clamped(fixed_time + frame * clip_frames / last_frame)))
    # A clip that is shorter than a frame has one, and one that hardly moves more than can be counted.
    frames = min(clip.frame_count * fps / clip.fps, MOST_FRAMES) if clip.frame_count > 1 else 1.0
    count = max(1, math.ceil(frames - SLACK))
    return Timeline(count, fps, lambda frame: (camera, _clamped(frame * clip_frames / last_frame)))


def _rig(scene: Scene, options: argparse.Namespace) -> tuple[RigCamera, ...]:
    """Return the cameras that see every frame."""
    if not scene.cameras:
        raise UsageError("--every-camera: the file lists no cameras; give --cameras")
    names = scene.metadata.names_of(len(scene.cameras))
    cameras = [_fitted(scene, options, camera) for camera in scene.cameras]
    return tuple(map(RigCamera, names, _file_names(names), cameras))


def _file_names(names: Sequence[str]) -> list[str]:
    """Return names of cameras that files can have, each once: the same whatever frames are rendered."""
    plain = [plain_name(name, most=100) for name in names]  # which leaves room for the frame
    counts = Counter(name.casefold() for name in plain)
    is_kept = all(plain) and max(counts.values()) == 1
    return plain if is_kept else [f"{number}_{name}" for number, name in enumerate(plain)]


def _fitted(scene: Scene, options: argparse.Namespace, camera: Camera) -> Camera:
    """Return a camera at the size that is asked for."""
    check_distance(scene, camera)
    return camera if options.size is None else fit_camera(camera, *options.size)


def check_distance(scene: Scene, camera: Camera, where: str = "") -> None:
    """Refuse a camera from which float32 cannot tell samples apart; in contracted space and NDC it can from anywhere.

    Args:
        scene: the scene.
        camera: the camera.
        where: the beginning of the message.

    Raises:
        UsageError: the camera is too far away.
    """
    if scene.mapping is None and (away := edges_away(scene.aabb, camera.camera_to_world[:3, 3])) > FARTHEST_CAMERA:
        raise UsageError(
            f"{where}a camera is {away:,.0f} times the longest edge of the scene's box away from it, where numbers are "
            f"too coarse (at most {FARTHEST_CAMERA:,.0f}); move it closer and shorten its focal length"
        )


def _clamped(time: float) -> float:
    return min(max(time, 0.0), 1.0)


def _orbit(scene: Scene, options: argparse.Namespace) -> list[View]:
    cameras = orbit(scene, options.orbit)
    times = np.linspace(0.0, 1.0, len(cameras))
    return [View(camera, float(time), "") for camera, time in zip(cameras, times, strict=True)]


def _camera(scene: Scene, options: argparse.Namespace) -> Camera:
    """Return the fixed camera that --camera chooses: a name or a number of the scene's, or a file that lists one view.

    Without, it is the view that the scene opens with.
    """
    if options.camera is None:
        opening = scene.metadata.opening
        return Rig.of(scene).cameras[0] if opening is None else opening.camera
    cameras = Rig.of(scene).cameras
    number = scene.metadata.camera_number(options.camera, len(cameras))
    if number is not None:
        if number >= len(cameras):
            raise UsageError(f"--camera {options.camera}: the scene has the cameras 0 to {len(cameras) - 1}")
        return cameras[number]
    if not Path(options.camera).exists():
        known = first_names(scene.metadata.names_of(len(cameras)))
        raise UsageError(f"--camera {options.camera}: neither a file nor a camera of the scene, which has {known}")
    views = load_views(Path(options.camera))
    if len(views) != 1:
        raise UsageError(f"--camera {options.camera}: lists {len(views)} views, not one; --cameras renders each")
    return views[0].camera
