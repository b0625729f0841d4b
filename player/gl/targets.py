"""What pictures are drawn into, on the graphics card, and how they get from there to memory and back."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import moderngl
import numpy as np
from kpc.format.common.errors import DisplayError

Bounds = tuple[float, float, float, float]
"""Left, bottom, right and top of a part of a picture, as shares of its sides."""
EVERYWHERE: Bounds = (0.0, 0.0, 1.0, 1.0)


@contextlib.contextmanager
def room_on(ctx: moderngl.Context, what: str) -> Iterator[None]:
    """Turns what moderngl raises while `what` is made into a DisplayError."""
    try:
        yield
    except moderngl.Error as error:
        name = ctx.info["GL_RENDERER"]
        raise DisplayError(
            f"{name} has no room for {what} ({error}); close other programs or use a smaller size"
        ) from error


@dataclass
class Target:
    """What a march draws into: rgb and opacity; sum of weight t, and samples. Row 0 is the bottom of the picture. All but what touches `drawn`
    is as rays see it that meet nothing."""

    seen: moderngl.Texture
    met: moderngl.Texture
    framebuffer: moderngl.Framebuffer
    drawn: Bounds = EVERYWHERE

    @staticmethod
    def of(ctx: moderngl.Context, size: tuple[int, int]) -> "Target":
        with room_on(ctx, f"a picture of {size[0]}x{size[1]}"):
            seen, met = ctx.texture(size, 4, dtype="f4"), ctx.texture(size, 2, dtype="f4")
            for texture in (seen, met):
                texture.repeat_x = texture.repeat_y = False
            return Target(seen, met, ctx.framebuffer([seen, met]))

    def release(self) -> None:
        for thing in (self.framebuffer, self.seen, self.met):
            thing.release()


@dataclass
class Canvas:
    """What is shown of a picture that is to be enlarged. In bytes: twelve of those a processor reads in less than half of the time that it
    takes for five filtered vectors of floats."""

    shown: moderngl.Texture
    framebuffer: moderngl.Framebuffer

    @staticmethod
    def of(ctx: moderngl.Context, size: tuple[int, int]) -> "Canvas":
        with room_on(ctx, f"a picture of {size[0]}x{size[1]}"):
            shown = ctx.texture(size, 4)
            return Canvas(shown, ctx.framebuffer([shown]))

    def release(self) -> None:
        self.framebuffer.release()
        self.shown.release()


def first_channel(target: Target) -> np.ndarray:
    """Of each of a small target's texels, the first channel of what is seen."""
    return np.frombuffer(target.seen.read(), np.float32)[::4]


def read_into(target: Target, first: tuple[int, int], seen: np.ndarray, met: np.ndarray) -> None:
    """A part of a target from column and row `first` on."""
    for number, array in enumerate((seen, met)):
        place = (*first, *array.shape[1::-1])
        target.framebuffer.read_into(
            array, place, components=array.shape[2], attachment=number, alignment=4, dtype="f4"
        )


def write(target: Target, first: tuple[int, int], seen: np.ndarray, met: np.ndarray) -> None:
    """Into a part of a target from column and row `first` on."""
    for texture, array in ((target.seen, seen), (target.met, met)):
        texture.write(np.ascontiguousarray(array), (*first, *array.shape[1::-1]))


def read(target: Target) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """rgb, depth, opacity and samples of a finished march, top row first."""
    width, height = target.framebuffer.size
    seen = np.frombuffer(target.seen.read(), np.float32).reshape(height, width, 4)[::-1]
    met = np.frombuffer(target.met.read(), np.float32).reshape(height, width, 2)[::-1]
    opacity = seen[..., 3].copy()
    depth = np.divide(met[..., 0], opacity, out=np.full_like(opacity, np.inf), where=opacity > 0)
    return seen[..., :3].copy(), depth, opacity, met[..., 1].astype(np.int32)
