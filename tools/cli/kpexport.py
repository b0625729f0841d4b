"""kpexport: exchange points, meshes and cameras with Blender, Houdini, Unreal, Nuke and other programs.

    kpexport scene.kpc -o points.ply --time 0.5          surfaces as coloured points
    kpexport scene.kpc -o frames/ --format glb --step 5  a file for every fifth frame
    kpexport scene.kpc -o mesh.glb --mesh --time 0       an isosurface of the density
    kpexport scene.kpc -o cameras.usda                   the scene's own cameras
    kpexport path.json -o path.usda --scene scene.kpc    a camera path of the player, or a camera file
    kpexport path.gltf -o path.json --scene scene.kpc    and back

What is written is y-up and in metres: it is turned and scaled by the up and the length of a unit in the scene's
metadata, if there are any.
"""

import argparse
import contextlib
import sys
import time as clock
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import kpc
from kpc.format.common import cli
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.common.progress import Progress, in_parts, part
from kpc.format.common.text import counted, escaped, notice
from kpc.format.container.groups import GroupedScene, Groups
from kpc.format.scene.cameras import Camera, View, save_views
from kpc.format.scene.metadata import Metadata, camera_document
from kpc.format.scene.rig import Rig
from kpc.format.scene.scene import Scene
from kpc.player.cpu.reference import Part
from kpc.player.viewpoints import fit_camera
from kpc.tools.exchange import gltf_cameras
from kpc.tools.exchange.camera_tracks import Track, load_tracks, placed, views_of
from kpc.tools.exchange.geometry_files import write_geometry
from kpc.tools.exchange.mesh import Mesh, surface_mesh
from kpc.tools.exchange.options import (
    DENSITY,
    PATH_FPS,
    RESOLUTION,
    SPACING_PARTS,
    USD_SUFFIXES,
    Task,
    check_path,
    parse,
)
from kpc.tools.exchange.placement import Placement
from kpc.tools.exchange.points import MAX_CELLS, Cloud, is_clipped, normals_of, surface_points
from kpc.tools.rendering.claims import claimed
from kpc.tools.rendering.content import Render, renderer_of
from kpc.tools.rendering.resuming import described
from kpc.tools.rendering.shots import Shots, rate_note, shots_of


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return cli.run(_command, "kpexport", argv)


def _command(argv: list[str]) -> None:
    options, task = parse(argv)
    cli.check_writable(Path(options.output), is_folder=task.is_folder)
    if task.kind == "geometry":
        _export_geometry(task, options)
    elif task.kind == "cameras":
        _export_cameras(task, options)
    else:
        _exchange_cameras(task, options)


def _export_geometry(task: Task, options: argparse.Namespace) -> None:
    """Write the points or the mesh of each frame."""
    if options.mesh:
        import_module("skimage")  # is missed before the scene is read, where it is not installed
    loaded = kpc.load(options.input)
    scene, _ = loaded.at(0.0)
    shots = _shots(scene, loaded, options)
    if not task.is_folder and len(shots) != 1:
        raise UsageError(f"-o {options.output}: {len(shots)} frames do not go into one file; give a folder or --time")
    if (note := rate_note(loaded.clip, options)) is not None:
        _say(note)
    placement = Placement.of(scene.metadata)
    _say_where(placement, scene.metadata)
    if is_clipped(scene):
        _say("the scene goes on beyond its box; only what lies in the box is exported")
    render = None if options.mesh else _renderer(loaded, shots, options)
    output = Path(options.output)
    started, count = clock.monotonic(), 0
    with contextlib.ExitStack() as alone:
        if task.is_folder:
            cli.make_folder(output)
            alone.enter_context(claimed(output, "kpexport", described(options)))
        bar = alone.enter_context(Progress("export", len(shots), "files"))
        for number in shots.numbers:
            time = shots.time(number)
            if render is None:
                shape: Mesh | Cloud = _mesh(loaded, time, options)
            else:
                shape = _points(loaded, render, time, options)
            path = output / f"{shots.name(number)}{task.suffix}" if task.is_folder else output
            write_geometry(path, shape, placement)
            count += len(shape.points)
            bar.advance()
    what = counted(count, "point") if not options.mesh else f"{count:,} {'vertex' if count == 1 else 'vertices'}"
    files = f"{counted(len(shots), 'file')}, " if task.is_folder else ""
    print(escaped(f"{output}: {files}{what}, in {clock.monotonic() - started:.1f} s"))


def _say_where(placement: Placement, metadata: Metadata) -> None:
    """Say how the scene is placed, if it is not kept where it is."""
    if not placement.is_identity:
        unit = "in metres" if "metres_per_unit" in metadata.document else "in units of the scene, whose length it lacks"
        _say(f"placed by the metadata of the scene: y is up, {unit}")


def _shots(scene: Scene, loaded: Scene | GroupedScene, options: argparse.Namespace) -> Shots:
    """Return the frames to export, as kprender chooses them."""
    wanted = {"time", "fps", "start_s", "end_s", "frames", "step"}
    times = {name: value for name, value in vars(options).items() if name in wanted}
    fixed = dict.fromkeys(("path", "cameras", "orbit", "camera", "every_camera", "size")) | {"shutter": 0.0}
    return shots_of(scene, loaded.clip, argparse.Namespace(**times, **fixed), is_film=False)


def _renderer(loaded: Scene | GroupedScene, shots: Shots, options: argparse.Namespace) -> Render:
    """Return a function that renders the scene over black."""
    black = {"content": None, "part": Part.FULL, "background": np.zeros(3, np.float32)}
    chosen = {name: getattr(options, name) for name in ("backend", "quality", "appearance")}
    render, name = renderer_of(loaded, argparse.Namespace(**black, **chosen), shots.times(), _say)
    _say(name)
    return render


def _points(loaded: Scene | GroupedScene, render: Render, time: float, options: argparse.Namespace) -> Cloud:
    scene, local_time = loaded.at(time)
    bounds = scene.bounds
    longest = float((bounds[1] - bounds[0]).max())
    spacing = options.spacing or longest / SPACING_PARTS
    if longest / spacing > MAX_CELLS:
        raise UsageError(f"--spacing {spacing:g}: a box of {longest:g} needs {longest / MAX_CELLS:.3g} or more")
    cameras = Rig.of(scene).cameras
    if options.size is not None:
        cameras = tuple(fit_camera(camera, *options.size) for camera in cameras)
    pictures = ((camera, render(camera, time)) for camera in in_parts(cameras))
    with part(2 / 3 if options.normals else 1):
        cloud = surface_points(pictures, bounds, spacing)
    if not len(cloud.points):
        raise KpcError(f"{options.input}: its cameras see no surface at time {time:g}; choose another --time")
    if not options.normals:
        return cloud
    with part(1 / 3):
        return Cloud(cloud.points, cloud.colours, normals_of(scene, local_time, cloud.points))


def _mesh(loaded: Scene | GroupedScene, time: float, options: argparse.Namespace) -> Mesh:
    scene, local_time = loaded.at(time)
    return surface_mesh(scene, local_time, options.resolution or RESOLUTION, options.density or DENSITY)


def _export_cameras(task: Task, options: argparse.Namespace) -> None:
    """Write the scene's own cameras for other programs."""
    opened = Groups(options.input)
    cameras, metadata = opened.cameras(), opened.metadata()
    if not cameras:
        raise KpcError(f"{options.input}: holds no cameras; give a camera file or a path of the player")
    others = (opened.open(number).cameras() for number in range(1, len(opened)))
    if any(_documents(other) != _documents(cameras) for other in others if other):
        _say("the groups of the clip have different cameras; those of the first are written")
    placement = Placement.of(metadata)
    _say_where(placement, metadata)
    names = metadata.names_of(len(cameras))
    tracks = [Track(name, (View(camera, 0.0, name),)) for name, camera in zip(names, cameras, strict=True)]
    _write_cameras(task, Path(options.output), placed(tracks, placement), PATH_FPS)


def _documents(cameras: Sequence[Camera]) -> list[dict[str, Any]]:
    return [camera_document(camera) for camera in cameras]


def _exchange_cameras(task: Task, options: argparse.Namespace) -> None:
    """Write cameras of the player for other programs, or the reverse."""
    source, output = Path(options.input), Path(options.output)
    source.stat()  # before anything is said of a file that is not there
    placement = Placement.of(None if options.scene is None else Groups(options.scene).metadata())
    if options.scene is None:
        _say("without --scene, coordinates are kept: y counts as up and a unit as a metre")
    if task.kind == "to":
        fps = float(options.fps or PATH_FPS)
        tracks = placed(load_tracks(source, None if options.keyframes else fps), placement)
        check_path(options, task, tracks[0].is_moving)
        _write_cameras(task, output, tracks, fps)
        return
    is_usd = source.suffix.lower() in USD_SUFFIXES
    read = _usd().read_usd_cameras if is_usd else gltf_cameras.read_gltf_cameras
    found, notes = read(source, options.size)
    views = views_of(options.input, placed(found, placement.inverse), options.camera)
    save_views(output, views)
    for note in notes:
        _say(note)
    print(escaped(f"{output}: {counted(len(views), 'view')}"))


def _write_cameras(task: Task, output: Path, tracks: list[Track], fps: float) -> None:
    """Write placed cameras as glTF or USD, and say what the file loses."""
    if task.suffix in USD_SUFFIXES:
        _usd().write_usd_cameras(output, tracks, fps)
    else:
        for note in gltf_cameras.write_gltf_cameras(output, tracks):
            _say(note)
    count = sum(len(track.views) for track in tracks)
    what = f"a path of {counted(count, 'instant')}" if tracks[0].is_moving else f"{counted(count, 'camera')}"
    print(escaped(f"{output}: {what}"))


def _usd() -> ModuleType:
    """Return the module for USD, which needs the extra `exchange`."""
    from kpc.tools.exchange import usd_cameras

    return usd_cameras


def _say(text: str) -> None:
    notice(f"kpexport: {text}")


if __name__ == "__main__":
    sys.exit(main())
