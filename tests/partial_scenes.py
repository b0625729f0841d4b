"""Small scenes in files, and scenes that are read from them segment by segment."""

import kpc
from kpc.encoder.coding.scene_writer import encode
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container.partial import PartialScene
from kpc.format.container.scene_io import SceneReader
from kpc.format.scene.scene import Scene


def coded(scene: Scene, segment_rows: int = 3) -> bytes:
    """Return the file of a scene, quantised with a step of 0.01."""
    steps = [dict.fromkeys(scale, 0.01) for scale in scene.scales]
    return encode(quantise_scene(scene, steps), segment_rows=segment_rows)


def opened(scene: Scene, segment_rows: int = 3) -> tuple[PartialScene, Scene]:
    """Return a partial scene of which no segment has been fetched, and the whole scene, as the file holds it."""
    data = coded(scene, segment_rows)
    return PartialScene(SceneReader(data, in_parts=True)), kpc.load(data)
