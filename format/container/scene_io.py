"""Reading scenes: the functions that most callers need.

    scene = read("scene.kpc").dequantise()

The layout of chunks is in `scene_layout`, what turns them into a scene in `scene_reader`; the encoder's
`kpc.encoder.coding.scene_writer` writes them.
"""

from kpc.format.container.scene_reader import SceneReader, read

__all__ = ["SceneReader", "read"]
