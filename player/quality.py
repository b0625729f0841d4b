"""How finely to draw: the settings that trade a picture's truth for its time, and a ladder of them to climb up and down.

    LADDER              from fastest to finest; name -> Quality. The last, "reference", is what the format says, exactly
    DEFAULT             the name of the knee of `kpbench player`'s curve: where a player begins
    climbed(name, +1)   the name of the next finer one

A `Renderer` takes a Quality when it is made, and another whenever its `quality` is set: no scene is uploaded again.

Measured and left out, for a processor that draws gains nothing from them (room, `fast`, 320x240):

* Density from half of the channels, and the others looked up where a sample weighs more than 1 / 256 of its pixel. The scene is worth
  0.03 dB less (soldier, a quarter of the channels: 0.2), but a picture takes 0.95 of the time where all that neighbours may need is
  done for each, and 1.15 where they wait for each other at the samples that matter.
* Planes of bytes with a factor for each layer: filtered look-ups of RGBA8 textures are made at 0.8 to 0.9 of the rate of float32 ones.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

from kpc.format.scene.scene import TERMINATION


@dataclass(frozen=True)
class Quality:
    """Of a picture. The default of every field is what the format says.

    Attributes:
        folded: multiply the rows of the time planes into the space planes once a frame, instead of sampling them beside the
            planes at every sample. Half the fetches, and a second-order error where something moves. On a graphics card folded planes
            are float16, which it looks up at more than twice the rate: room is 74 dB and soldier 80 dB from their pictures in float32.
            What is larger than 65,504 is cut off there, what is smaller than 6e-5 loses digits, 6e-8 at most. A processor that would draw
            what `Lookup` serves folds nothing then, and marches it itself, from the scene's own numbers.
        step: distance between samples, in steps of the scene.
        termination: a ray ends once its transmittance falls below this. Where that is more than the format's TERMINATION, what
            is left of its light counts as what it has met so far.
        share: scales whose texels are at least so many steps long are looked up by shaders once for two samples, in the middle between them. Where
            those of room are, 3.4 steps long, a processor that draws by shaders takes 0.9 of the time, and the worst picture is 40.2 dB from exact, not 42.7.
        tolerance: while the clip plays, a picture is predicted from the one before. One pixel of each block of sixteen is marched,
            all by turns; blocks where that differs from the prediction by more than this, of the full range, or a neighbour's by
            twice as much, are marched whole. 0: no picture follows another.
        blur: a picture that follows no other is marched with half of the rays across and up first, and those with half of them, as long as there
            is one for each texel, and the others are interpolated. Blocks that are off the most by that are marched whole, until what
            is left is at most this, of the full range: the root of the mean of its squares over the picture, as far as bends tell
            (bent.glsl). 0: all pixels are marched.
        resolution: side of the raster that is marched over that of the picture, in (0, 1]; the rest is interpolated, by a cubic (cubic.glsl).
        thin: where a processor draws, rays pass by occupied cells that are empty at the time: a step at their corners has less alpha than
            this. 0: they stop in all.
        baked: let a processor that would draw march a scene that `Baking` serves itself, through a grid of what the planes come to at the corners
            of their texels. Then all pixels are marched, no picture follows another, rays stop in all occupied cells, and end once their
            transmittance falls below this: of soldier's 53.7 dB, 1 / 16 costs 1, 1 / 8 costs 4. 0: it marches none.
        across: rays across a pixel, at most: as many as it spans texels of the finest scale, and their mean is its colour. What is far
            away else shimmers. Room in a picture so small that a pixel spans three texels is 30.0 dB from that of 36 rays a pixel,
            and 40.3 with 2 x 2; prefiltered planes of half and a quarter of the resolution gave 33.4 and 29.9 (products of means are
            no means of products).
        scales: how many of the scene's to use, from the coarsest on; None: all.
    """

    folded: bool = False
    step: float = 1.0
    termination: float = TERMINATION
    share: float = math.inf
    tolerance: float = 0.0
    blur: float = 0.0
    resolution: float = 1.0
    thin: float = 0.0
    baked: float = 0.0
    across: int = 1
    scales: int | None = None

    def __post_init__(self) -> None:
        marchable = (
            self.step >= 1
            and self.share > 0
            and 0 < self.termination < 1
            and 0 < self.resolution <= 1
            and self.tolerance >= 0
            and self.blur >= 0
            and 0 <= self.thin < 1
            and 0 <= self.baked < 1
            and self.across >= 1
        )
        if not marchable or self.scales is not None and self.scales < 1:
            raise ValueError(f"no picture can be drawn with {self}")


BLUR = 1.6 / 255
"""44 dB. Of a picture of 640x480 that follows none: time of that without, and PSNR with and without. shelf_hand 0.15, 47.8 instead of 53.4 dB;
soldier 0.53, 45.5 (54.4); liam 0.75, 40.2 (42.9); room, full of fine patterns, 0.84, 41.1 (45.0). With half of it: 0.18, 49.9; 0.75, 50.0;
0.90, 42.0; 0.95, 43.8."""

LADDER: dict[str, Quality] = {
    "fastest": Quality(
        folded=True,
        step=2.0,
        termination=1 / 16,
        share=2.0,
        tolerance=5 / 255,
        blur=BLUR,
        thin=1 / 32,
        baked=1 / 8,
        resolution=0.5,
    ),
    "faster": Quality(
        folded=True,
        termination=1 / 16,
        share=2.0,
        tolerance=5 / 255,
        blur=BLUR,
        thin=1 / 32,
        baked=1 / 8,
        resolution=0.5,
    ),
    "fast": Quality(
        folded=True,
        termination=1 / 16,
        share=2.0,
        tolerance=5 / 255,
        blur=BLUR,
        thin=1 / 32,
        baked=1 / 8,
        resolution=0.75,
    ),
    "quick": Quality(
        folded=True, termination=1 / 16, share=2.0, tolerance=5 / 255, blur=BLUR, thin=1 / 32, baked=1 / 8, across=4
    ),
    "balanced": Quality(
        folded=True, termination=1 / 32, share=3.5, tolerance=5 / 255, blur=BLUR, thin=1 / 32, baked=1 / 16, across=4
    ),
    "fine": Quality(folded=True, termination=1 / 64, share=3.5, blur=BLUR / 4, thin=1 / 256, across=4),
    "finer": Quality(folded=True, across=4),
    "reference": Quality(),
}
"""From fastest to finest."""

DEFAULT = "balanced"
"""The knee. On all scenes of docs/bench/player.json, its worst pictures are within 40 dB of the reference; of what is faster, so are only those of `quick`,
which saves a twentieth of the time at most, and a processor's alone."""


def climbed(name: str, rungs: int, passed_over: Collection[str] = ()) -> str:
    """The name so many rungs up the ladder from `name`, or at its end; some do not count."""
    names = [rung for rung in LADDER if rung == name or rung not in passed_over]
    return names[min(max(names.index(name) + rungs, 0), len(names) - 1)]
