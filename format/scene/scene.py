"""A decoded scene as plain data: what the encoder hands over, the file stores and every renderer reads.

Feature of a point p at time t (K-Planes, arXiv:2301.10241, eq. 1; multiplication over planes, concatenation over scales):

    f_s(p, t) = prod over planes c of bilinear(P[s][c], project_c(p, t))         f = concat over scales s of f_s

With a motion grid the planes are read elsewhere, `kpc.format.scene.motion`. Density and colour, per longest edge of the box, come from
the explicit decoder (section 3.3 of the paper), in which a direction MLP gives the basis once a ray,

    sigma = exp(clip(f . density_weight + density_bias, -20, 20))       rgb = sigmoid(f . basis_{R,G,B}(d))

or from the hybrid one, two small MLPs for each sample: `HybridDecoder`.

Pictures that disagree about colours (exposure, white balance, time of day) have each an appearance: a code that is added to the
hidden layer that depends on the direction, and to nothing else, so that it never changes geometry (section 3.3 of the paper).
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from kpc.format.common.errors import UsageError
from kpc.format.scene.cameras import Camera
from kpc.format.scene.space import DeviceCoordinates, SpaceMapping

SPACE_PLANES = ("xy", "xz", "yz")
TIME_PLANES = ("xt", "yt", "zt")
ALL_PLANES = SPACE_PLANES + TIME_PLANES

LOG_DENSITY_LIMIT = 20.0
"""|log density| is clipped here: exp(20) is opaque within any step, exp(-20) is empty over any box."""

ACTIVATION_LIMIT = 65504.0
"""Hidden units of the hybrid decoder are clipped here: float16 holds them, and their weighted sums stay finite in float32."""

TERMINATION = 1.0 / 1024.0
"""A ray ends once its transmittance falls below this; a quarter of an 8-bit level."""


@dataclass(frozen=True)
class Clip:
    """The time axis: `frame_count` pictures at `fps`; time 0 is the first picture and time 1 the last."""

    frame_count: int
    fps: float

    @property
    def duration_s(self) -> float:
        return (self.frame_count - 1) / self.fps if self.frame_count > 1 else 0.0


@dataclass(frozen=True)
class Decoder:
    """The explicit decoder. F is the sum of channels over scales, H the hidden width.

    Attributes:
        density_weight: (F,) float32; density_bias: float32 scalar.
        w1: (H, 9), b1: (H,), w2: (3, F, H), b2: (3, F) float32, the direction MLP, `code` that of an appearance or 0:
            basis(d) = w2 relu(w1 e(d) + b1 + code) + b2,  e(d) = [x, y, z, xx, yy, zz, xy, yz, zx]
    """

    density_weight: np.ndarray
    density_bias: float
    w1: np.ndarray
    b1: np.ndarray
    w2: np.ndarray
    b2: np.ndarray

    @staticmethod
    def shapes(features: int, hidden: int) -> dict[str, tuple[int, ...]]:
        """Of the arrays, in their order."""
        return {
            "density_weight": (features,),
            "w1": (hidden, 9),
            "b1": (hidden,),
            "w2": (3, features, hidden),
            "b2": (3, features),
        }

    @property
    def parameter_count(self) -> int:
        return sum(np.size(weights) for weights in vars(self).values())


@dataclass(frozen=True)
class HybridDecoder:
    """The hybrid decoder (section 3.3 of the paper): MLPs in place of both linear maps. G and H are their widths.

        h     = clip(v f + v_bias, 0, ACTIVATION_LIMIT)
        sigma = exp(clip(h . density_weight + density_bias, -20, 20))
        rgb   = sigmoid(w2 clip(w1 e(d) + b1 + code + u h, 0, ACTIVATION_LIMIT) + b2)    e(d) as in `Decoder`; once a ray but u h

    The paper hands a few linear outputs of the density's MLP on to the colour's; here its hidden layer is handed on as it is.

    Attributes:
        v: (G, F), v_bias: (G,), density_weight: (G,) float32; density_bias: float32 scalar.
        w1: (H, 9), b1: (H,), u: (H, G), w2: (3, H), b2: (3,) float32.
    """

    v: np.ndarray
    v_bias: np.ndarray
    density_weight: np.ndarray
    density_bias: float
    w1: np.ndarray
    b1: np.ndarray
    u: np.ndarray
    w2: np.ndarray
    b2: np.ndarray

    @staticmethod
    def shapes(features: int, width: int, hidden: int) -> dict[str, tuple[int, ...]]:
        """Of the arrays, in their order."""
        return {
            "v": (width, features),
            "v_bias": (width,),
            "density_weight": (width,),
            "w1": (hidden, 9),
            "b1": (hidden,),
            "u": (hidden, width),
            "w2": (3, hidden),
            "b2": (3,),
        }

    @property
    def parameter_count(self) -> int:
        return sum(np.size(weights) for weights in vars(self).values())


AnyDecoder = Decoder | HybridDecoder


@dataclass(frozen=True)
class Appearance:
    """How one picture or camera, `name`, shows the colours of a scene: `code` (H,) float32, H as in `Decoder`. All of a scene's
    average 0, the look without a code."""

    name: str
    code: np.ndarray


@dataclass(frozen=True)
class Scene:
    """A radiance field that can be rendered at any time in [0, 1] from anywhere.

    Attributes:
        aabb: (2, 3) float32, lower and upper corner of the box, world units. With a contraction, of what it leaves undistorted;
            with device coordinates, in those.
        clip: its time axis.
        scales: coarse to fine; each maps plane names to (rows, columns, M) float32. The plane's first letter is the column
            axis, the second the row axis: "xy" is (Ny, Nx, M), "xt" is (T, Nx, M). Static scenes hold SPACE_PLANES only,
            others ALL_PLANES. Corner-aligned: u in [0, 1] over the box, or where `mapping` puts a point, reads at
            u * (size - 1).
        decoder: density and colour from features.
        occupancy: (slots, Nz, Ny, Nx) bool. A cell that is False holds nothing while its slot of time lasts;
            slot k of K lasts over [k/K, (k+1)/K) of the clip, the last one includes time 1.
        background: (3,) float32 in [0, 1], seen where a ray ends with transmittance left.
        step: distance between samples along a ray, world units; with a contraction in its s, in device coordinates in those.
        cameras: a few cameras the scene was filmed from, the first a good one to open on.
        mapping: how what lies outside the box is held, too; None: nothing does.
        motion: (T, Nz, Ny, Nx, 3) float32, displacements at the nodes of a grid over time and space, in box edges (of what the
            planes cover, with a mapping), `kpc.format.scene.motion`; None: nothing is displaced. Dynamic scenes only.
        appearances: how its pictures or cameras showed its colours, names all different; none where they agree.
    """

    aabb: np.ndarray
    clip: Clip
    scales: tuple[Mapping[str, np.ndarray], ...]
    decoder: AnyDecoder
    occupancy: np.ndarray
    background: np.ndarray
    step: float
    cameras: tuple[Camera, ...] = field(default=())
    mapping: SpaceMapping | None = None
    motion: np.ndarray | None = None
    appearances: tuple[Appearance, ...] = field(default=())

    def at(self, time: float) -> "tuple[Scene, float]":
        """What shows at a time, and the time in it: as of a clip in groups (`kpc.format.container.groups.GroupedScene`), but always itself."""
        return self, time

    def blend_at(self, time: float) -> "list[tuple[Scene, float, float]]":
        """What makes the picture at a time, likewise: itself, the time in it, its share."""
        return [(self, time, 1.0)]

    @property
    def is_dynamic(self) -> bool:
        return "xt" in self.scales[0]

    @property
    def extent(self) -> float:
        """Longest edge of the box, the unit of length in which density is expressed."""
        return float(np.max(self.aabb[1] - self.aabb[0]))

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64, world units: the box, or the smallest one around what it is in the world."""
        aabb = self.aabb.astype(np.float64)
        if not isinstance(self.mapping, DeviceCoordinates):
            return aabb
        corners = self.mapping.to_world(np.array(list(itertools.product(*aabb.T))))
        return np.stack([corners.min(0), corners.max(0)])

    @property
    def parameter_count(self) -> int:
        """Numbers in the model: every texel of every channel of every plane, the decoder's weights, displacements, codes."""
        motion = 0 if self.motion is None else self.motion.size
        codes = sum(appearance.code.size for appearance in self.appearances)
        return (
            sum(p.size for scale in self.scales for p in scale.values()) + self.decoder.parameter_count + motion + codes
        )

    def appearance(self, name: str) -> np.ndarray:
        """The code of an appearance, (H,) float32.

        Raises:
            UsageError: there is none of that name; the message names some.
        """
        for appearance in self.appearances:
            if appearance.name == name:
                return appearance.code
        if not self.appearances:
            raise UsageError(f"appearance {name!r}: the scene has none, all its pictures agree; leave it out")
        some = ", ".join(appearance.name for appearance in self.appearances[:8]) + ", ..." * (len(self.appearances) > 8)
        raise UsageError(f"appearance {name!r}: the scene has no such one, but {some}")

    def interpolate_appearance(self, one: str, other: str, share: float) -> np.ndarray:
        """The code so far from one appearance to another, share in [0, 1]: (1 - share) one + share other, (H,) float32.

        Raises:
            UsageError: as `appearance`.
        """
        return np.float32(1 - share) * self.appearance(one) + np.float32(share) * self.appearance(other)
