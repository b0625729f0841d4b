"""A small picture of a scene in training beside what was filmed: `kpenc --preview`."""

import itertools
import math
import time
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from kpc.encoder.datasets import Dataset, pixel_rays
from kpc.encoder.evaluation.evaluate import SceneRenderer
from kpc.encoder.evaluation.ground_truth import ground_truth
from kpc.encoder.evaluation.moving import MovingPixels
from kpc.encoder.training.train import Trainer
from kpc.format.common.cli import atomic_write
from kpc.format.common.fidelity import psnr
from kpc.format.scene.space import DeviceCoordinates

SIDE = 320  # pixels of the longer side of either picture, at most
EVERY_S, AT_MOST_S = 10.0, 60.0  # seconds between two previews, at least and at most
SHARE = 0.05  # of the time that previews may take, within these bounds
CAPTION_HEIGHT, CAPTION_LEFT = 14, 2
BOX_COLOUR = (255, 200, 0)


class Preview:
    """Writes a PNG of one view: the scene in training on the left, what was filmed on the right, and the box on both.

    The view is a held-out picture where there is one, else a training picture, from the middle of the clip.
    """

    def __init__(self, dataset: Dataset, path: Path) -> None:
        """Choose the view and find out what moves in it.

        Args:
            dataset: holds the picture.
            path: of the PNG, which each preview replaces.
        """
        self.dataset, self.path = dataset, path
        pictures = dataset.pictures
        candidates = np.flatnonzero(pictures.is_test) if pictures.is_test.any() else np.arange(len(pictures))
        same = candidates[pictures.camera[candidates] == pictures.camera[candidates[0]]]
        same = same[np.argsort(pictures.time[same], kind="stable")]
        self.number = int(same[len(same) // 2])
        self.stride = -(-int(max(pictures.width[self.number], pictures.height[self.number])) // SIDE)
        self.truth = ground_truth(dataset, self.number)[:: self.stride, :: self.stride]
        mask = MovingPixels(dataset, self.stride).mask(self.number)
        self.moving = np.zeros(self.truth.shape[:2], bool) if mask is None else mask
        self._due = 0.0

    def update(self, trainer: Trainer, step: int) -> None:
        """Write a preview if it is time for one."""
        started = time.monotonic()
        if started < self._due:
            return
        self.write(trainer, step)
        spent = time.monotonic() - started
        self._due = started + spent + min(max(EVERY_S, spent / SHARE), AT_MOST_S)

    def write(self, trainer: Trainer, step: int) -> None:
        """Render the view and write the PNG."""
        drawn = np.clip(self._render(SceneRenderer(trainer.scene())), 0, 1)
        height, width = drawn.shape[:2]
        caption = self.caption(drawn, step)
        room = math.ceil(ImageFont.load_default().getlength(caption)) + 2 * CAPTION_LEFT  # small pictures have less
        image = Image.new("RGB", (max(2 * width, room), height + CAPTION_HEIGHT))
        draw = ImageDraw.Draw(image)
        for left, pixels in ((0, drawn), (width, self.truth)):
            image.paste(Image.fromarray((255 * pixels + 0.5).astype(np.uint8)), (left, 0))
        if not isinstance(trainer.mapping, DeviceCoordinates):  # whose box is not in the world
            for left in (0, width):
                for line in box_edges(self.dataset, self.number, trainer.aabb, self.stride):
                    draw.line([(x + left, y) for x, y in line], fill=BOX_COLOUR)
        draw.text((CAPTION_LEFT, height + 1), caption, fill=(255, 255, 255))
        with atomic_write(self.path) as temporary:
            image.save(temporary)

    def caption(self, drawn: np.ndarray, step: int) -> str:
        """Return the step, and the PSNR of moving and of still pixels, or of all where nothing is known to move."""
        parts = {"moving": self.moving, "still": ~self.moving} if self.moving.any() else {"PSNR": ~self.moving}
        values = [f"{name} {psnr(drawn[mask], self.truth[mask]):.1f} dB" for name, mask in parts.items() if mask.any()]
        return ", ".join([f"step {step:,}", *values])

    def _render(self, renderer: SceneRenderer) -> np.ndarray:
        height, width = self.truth.shape[:2]
        row, column = (self.stride * index for index in np.divmod(np.arange(height * width), width))
        pictures, number = self.dataset.pictures, np.full(height * width, self.number)
        origins, directions = pixel_rays(pictures, number, column, row, renderer.scene.mapping)
        return renderer.rgb(origins, directions, pictures.time[number]).reshape(height, width, 3)


def box_edges(dataset: Dataset, number: int, aabb: np.ndarray, stride: int) -> list[list[tuple[float, float]]]:
    """Return the visible edges of a (2, 3) box in a picture as short lines of two points (x, y), without distortion.

    Args:
        dataset: holds the picture.
        number: of the picture.
        aabb: in world space.
        stride: pixels of the picture to one of the preview.
    """
    camera = dataset.camera(number)
    corners = np.array(list(itertools.product(*aabb.T)), np.float64)
    pairs = [(a, b) for a, b in itertools.combinations(range(8), 2) if bin(a ^ b).count("1") == 1]
    share = np.linspace(0, 1, 33)[:, None]
    lines = []
    for a, b in pairs:
        points = corners[a] * (1 - share) + corners[b] * share
        local = (points - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
        depth = -local[:, 2]
        ahead = depth > 1e-6
        x = camera.cx + camera.fl_x * local[:, 0] / np.where(ahead, depth, 1)
        y = camera.cy - camera.fl_y * local[:, 1] / np.where(ahead, depth, 1)
        inside = ahead & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        ends = np.stack([x, y], axis=-1) / stride
        lines += [
            [tuple(ends[k].tolist()), tuple(ends[k + 1].tolist())]
            for k in range(len(share) - 1)
            if inside[k] and inside[k + 1]
        ]
    return lines
