"""The quality levels: how much of a picture's accuracy is given up for speed. Every level is one row of `LEVELS`.

    LEVELS                            name -> Quality, from the fastest to the exact one
    DEFAULT                           the level at which a player on a processor begins
    neighbouring_level(name, +1)      the name of the next finer level

A `kpc.player.gl.renderer.Renderer` takes a Quality when it is made, and another one whenever its `quality` attribute is
set; nothing is uploaded again. Measurements behind the values, and variants that were tried and left out:
docs/design/drawing.md.
"""

from dataclasses import dataclass

from kpc.format.scene.scene import TERMINATION


@dataclass(frozen=True)
class Quality:
    """The settings of a picture. The default of every field is what the format says, exactly.

    Attributes:
        folded: who draws. False: the exact shaders, which look up space planes and time rows at every sample. True: a
            graphics card marches space planes into which it multiplies ("folds") the time rows once a frame; where a
            software driver would draw, the processor's own code marches (`kpc.player.cpu.cpu_renderer`).
        step: distance between samples, in steps of the scene, at least 1.
        termination: a ray ends once its transmittance is below this. If that is more than the format's TERMINATION, the
            remaining light is given the colour met so far.
        resolution: side of the raster that is marched over that of the picture, in (0, 1]; the rest is interpolated by
            a cubic.
        rays_across: rays across a pixel, at most: as many as it spans texels of the finest scale. Their mean is the
            pixel's colour.
        reprojection_tolerance: processor, and in browsers while the camera rests. While the clip plays, a picture is
            predicted from the one before; blocks of 4 x 4 pixels whose sample pixel differs from the prediction by more
            than this, of the full range, are marched again. 0: none is predicted.
        interpolation_tolerance: processor only. A picture that is not predicted is marched at a lower resolution first
            and interpolated; the blocks that are off the most are marched until the RMS error left is at most this, of
            the full range. 0: all pixels are marched.
        culling_alpha: processor only. Rays skip occupied cells whose corners have less alpha than this at the present
            time. 0: none.
        grid_termination: processor only. Scenes that `kpc.player.cpu.corner_grid` serves are marched through its grid,
            and their rays end once their transmittance is below this. 0: the grid is not used.
    """

    folded: bool = False
    step: float = 1.0
    termination: float = TERMINATION
    resolution: float = 1.0
    rays_across: int = 1
    reprojection_tolerance: float = 0.0
    interpolation_tolerance: float = 0.0
    culling_alpha: float = 0.0
    grid_termination: float = 0.0

    def __post_init__(self) -> None:
        is_valid = (
            self.step >= 1
            and 0 < self.termination < 1
            and 0 < self.resolution <= 1
            and self.rays_across >= 1
            and self.reprojection_tolerance >= 0
            and self.interpolation_tolerance >= 0
            and 0 <= self.culling_alpha < 1
            and 0 <= self.grid_termination < 1
        )
        if not is_valid:
            raise ValueError(f"invalid quality settings: {self}")


# How far a sample pixel may be off its prediction, of the full range: five 8-bit levels.
REPROJECTION = 5 / 255
# RMS of the interpolated pixels, 44 dB.
INTERPOLATION = 1.6 / 255

# The columns of LEVELS, in the order of the fields of Quality.
_COLUMNS = (
    "folded", "step", "termination", "resolution", "rays_across",
    "reprojection_tolerance", "interpolation_tolerance", "culling_alpha", "grid_termination",
)  # fmt: skip
_ROWS = {
    #           folded  step  termination  resol. rays  reprojection  interpolation      culling  grid
    "fastest":  (True,  2.0,  1 / 16,      0.5,   1,    REPROJECTION, INTERPOLATION,     1 / 32,  1 / 8),
    "faster":   (True,  1.0,  1 / 16,      0.5,   1,    REPROJECTION, INTERPOLATION,     1 / 32,  1 / 8),
    "fast":     (True,  1.0,  1 / 16,      0.75,  1,    REPROJECTION, INTERPOLATION,     1 / 32,  1 / 8),
    "balanced": (True,  1.0,  1 / 32,      1.0,   4,    REPROJECTION, INTERPOLATION,     1 / 32,  1 / 16),
    "fine":     (True,  1.0,  1 / 64,      1.0,   4,    0.0,          INTERPOLATION / 4, 1 / 256, 0.0),
    "finer":    (True,  1.0,  TERMINATION, 1.0,   4,    0.0,          0.0,               0.0,     0.0),
    "reference": (False, 1.0, TERMINATION, 1.0,   1,    0.0,          0.0,               0.0,     0.0),
}  # fmt: skip
LEVELS: dict[str, Quality] = {
    name: Quality(**dict(zip(_COLUMNS, row, strict=True)))  # type: ignore[arg-type]
    for name, row in _ROWS.items()
}

# The knee of `kpbench player`'s curve: the fastest level whose pictures are all within 40 dB of the reference.
DEFAULT = "balanced"


def neighbouring_level(name: str, offset: int) -> str:
    """Return the level `offset` places finer (negative: faster) than `name`, or the last in that direction."""
    names = list(LEVELS)
    return names[min(max(names.index(name) + offset, 0), len(names) - 1)]
