"""Reading and writing scenes: the functions that most callers need.

    scene = read("scene.kpc").dequantise()
    write(quantise_scene(scene, steps), "scene.kpc")

The layout of chunks is in `scene_layout`, what turns them into a scene and back in `scene_reader` and `scene_writer`.
"""

from kpc.format.container.scene_reader import SceneReader, read
from kpc.format.container.scene_writer import encode, save, scene_chunks, write

__all__ = ["SceneReader", "encode", "read", "save", "scene_chunks", "write"]
