"""The data model of a decoded scene: what the encoder produces, a file stores and every renderer reads.

A scene is a K-Planes radiance field (arXiv:2301.10241, eq. 1). A point p at time t is projected onto six planes of
features at each of several scales; samples are multiplied over the planes and concatenated over the scales:

    f_s(p, t) = prod over planes c of bilinear(P[s][c], project_c(p, t))         f = concat over scales s of f_s

Where each part is described:

    Scene                    everything together: box, planes, decoder, occupancy, cameras
    Clip                     the time axis
    Decoder, HybridDecoder   features and view direction -> density and colour
    Appearance               one image's exposure, white balance or lighting, as an embedding
    kpc.format.scene.space   how points outside the box are mapped into the planes
    kpc.format.scene.motion  the motion grid, which displaces points before the planes are sampled

Conventions: the world is right-handed; positions are in world units; times are in [0, 1] over the clip unless a name
ends in `_s` (seconds). Arrays over space are indexed [z, y, x]; arrays over time and space [t, z, y, x]. All grids are
corner-aligned: u in [0, 1] is read at u * (size - 1). Density is per longest edge of the box (`Scene.extent`).
"""

import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from kpc.format.common.errors import UsageError
from kpc.format.common.text import first_names
from kpc.format.scene.cameras import Camera
from kpc.format.scene.metadata import Metadata
from kpc.format.scene.sound import Sound
from kpc.format.scene.space import DeviceCoordinates, SpaceMapping

SPACE_PLANES = ("xy", "xz", "yz")
TIME_PLANES = ("xt", "yt", "zt")
ALL_PLANES = SPACE_PLANES + TIME_PLANES

# The logarithm of density is clipped to this magnitude: exp(20) is opaque within any step, exp(-20) empty over any box.
LOG_DENSITY_LIMIT = 20.0

# Hidden units of the hybrid decoder are clipped to this, the largest float16: their weighted sums stay finite in
# float32.
ACTIVATION_LIMIT = 65504.0

# A ray ends once its transmittance falls below this, a quarter of an 8-bit level.
TERMINATION = 1.0 / 1024.0


@dataclass(frozen=True)
class Clip:
    """The time axis: time 0 is the first frame and time 1 the last.

    Attributes:
        frame_count: at least 1; a static scene has 1.
        fps: frames per second, > 0.
    """

    frame_count: int
    fps: float

    @property
    def duration_s(self) -> float:
        """Seconds from the first frame to the last."""
        return (self.frame_count - 1) / self.fps if self.frame_count > 1 else 0.0

    @property
    def total_s(self) -> float:
        """Seconds for which all frames are shown, the last one as long as the others."""
        return self.frame_count / self.fps


@dataclass(frozen=True)
class Decoder:
    """The explicit decoder (K-Planes, section 3.3): both outputs are linear in the features f.

        sigma = exp(clip(f . density_weight + density_bias, -LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT))
        rgb_c = sigmoid(f . basis_c(d))        for c = R, G, B
        basis(d) = w2 relu(w1 e(d) + b1 + code) + b2,    e(d) = [x, y, z, xx, yy, zz, xy, yz, zx]

    d is the unit view direction, so the basis is evaluated once per ray. `code` is that of an `Appearance`, or 0.
    F is the number of features, the sum of channels over scales; H is the hidden width.
    """

    density_weight: np.ndarray  # (F,) float32
    density_bias: float
    w1: np.ndarray  # (H, 9) float32
    b1: np.ndarray  # (H,) float32
    w2: np.ndarray  # (3, F, H) float32
    b2: np.ndarray  # (3, F) float32

    @staticmethod
    def shapes(features: int, hidden: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the arrays by name, in the order in which they are stored."""
        return {
            "density_weight": (features,),
            "w1": (hidden, 9),
            "b1": (hidden,),
            "w2": (3, features, hidden),
            "b2": (3, features),
        }

    @property
    def parameter_count(self) -> int:
        """The number of weights, biases included."""
        return sum(np.size(weights) for weights in vars(self).values())


@dataclass(frozen=True)
class HybridDecoder:
    """The hybrid decoder (K-Planes, section 3.3): two small MLPs, evaluated at every sample.

        h     = clip(v f + v_bias, 0, ACTIVATION_LIMIT)
        sigma = exp(clip(h . density_weight + density_bias, -LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT))
        rgb   = sigmoid(w2 clip(w1 e(d) + b1 + code + u h, 0, ACTIVATION_LIMIT) + b2)

    e(d) and `code` are as in `Decoder`; all terms of the colour's hidden layer but u h are evaluated once per ray.
    Unlike the paper's, the colour MLP reads the hidden layer h of the density MLP directly, not linear outputs of it.
    F is the number of features, G the width of h and H that of the colour's hidden layer.
    """

    v: np.ndarray  # (G, F) float32
    v_bias: np.ndarray  # (G,) float32
    density_weight: np.ndarray  # (G,) float32
    density_bias: float
    w1: np.ndarray  # (H, 9) float32
    b1: np.ndarray  # (H,) float32
    u: np.ndarray  # (H, G) float32
    w2: np.ndarray  # (3, H) float32
    b2: np.ndarray  # (3,) float32

    @staticmethod
    def shapes(features: int, width: int, hidden: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the arrays by name, in the order in which they are stored."""
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
        """The number of weights, biases included."""
        return sum(np.size(weights) for weights in vars(self).values())


AnyDecoder = Decoder | HybridDecoder


@dataclass(frozen=True)
class Appearance:
    """The appearance embedding of one image or camera: its exposure, white balance or time of day.

    The code is added to the hidden layer that depends on the view direction and to nothing else, so it never changes
    geometry (K-Planes, section 3.3). The codes of a scene have mean 0: rendering without a code gives the average look.

    Attributes:
        name: of the image file or camera.
        code: (H,) float32, H the hidden width of the decoder.
    """

    name: str
    code: np.ndarray


def common_names(groups: Iterable[Sequence[Appearance]]) -> list[str]:
    """Return the names that are in all groups of a clip that have appearances, in the order of the first of them."""
    known = [[one.name for one in group] for group in groups if group]
    return [name for name in known[0] if all(name in names for names in known)] if known else []


@dataclass(frozen=True)
class Scene:
    """A radiance field that can be rendered from any viewpoint at any time in [0, 1].

    Attributes:
        aabb: (2, 3) float32, lower and upper corner of the box in world units. With a `Contraction` it is the part of
            space that is not contracted; with `DeviceCoordinates` it is in those coordinates.
        clip: the time axis.
        scales: coarse to fine; each maps plane names to (rows, columns, M) float32 arrays of M channels. A plane's
            first letter names the axis of its columns, the second that of its rows: "xy" is (Ny, Nx, M), "xt" is (T,
            Nx, M). A static scene has the SPACE_PLANES, a dynamic one ALL_PLANES. Time planes are 1 where nothing
            changes.
        decoder: density and colour from features.
        occupancy: (slots, Nz, Ny, Nx) bool, the occupancy grid. Slot k of K holds for times in [k/K, (k+1)/K), the last
            slot for time 1, too. Space is empty wherever a cell is False.
        background: (3,) float32 in [0, 1], the colour behind the scene.
        step: distance between samples along a ray, in world units; in the ray parameter s of a `Contraction`, or in
            device coordinates, where the scene has such a mapping.
        cameras: some of the cameras that the scene was captured with; a viewer opens on the first.
        mapping: how points outside the box are mapped into the planes; None if the scene ends with its box.
        motion: (T, Nz, Ny, Nx, 3) float32, the motion grid: displacements in edges of the box (with a mapping: of the
            region that the planes cover); see `kpc.format.scene.motion`. None without motion, and in static scenes.
        appearances: embeddings with unique names; empty if all images agree in colour.
        metadata: what the file says of itself.
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
    metadata: Metadata = field(default_factory=Metadata)
    sound: Sound | None = None

    def at(self, time: float) -> "tuple[Scene, float]":
        """Return the scene shown at `time` and the time in it: itself and `time`.

        A clip in groups has the same method (`kpc.format.container.groups.GroupedScene`).
        """
        return self, time

    def blend_at(self, time: float) -> "list[tuple[Scene, float, float]]":
        """Return the (scene, time in it, weight) triples blended at `time`: itself, with weight 1.

        A clip in groups has the same method (`kpc.format.container.groups.GroupedScene`).
        """
        return [(self, time, 1.0)]

    @property
    def is_dynamic(self) -> bool:
        """Whether the scene has time planes."""
        return "xt" in self.scales[0]

    @property
    def extent(self) -> float:
        """The longest edge of the box: the unit of length of density."""
        return float(np.max(self.aabb[1] - self.aabb[0]))

    @property
    def bounds(self) -> np.ndarray:
        """The box in world units, (2, 3) float64; with device coordinates, its bounding box in the world."""
        aabb = self.aabb.astype(np.float64)
        if not isinstance(self.mapping, DeviceCoordinates):
            return aabb
        corners = self.mapping.to_world(np.array(list(itertools.product(*aabb.T))))
        return np.stack([corners.min(0), corners.max(0)])

    @property
    def parameter_count(self) -> int:
        """The number of values in the model: planes, decoder, motion grid and appearance codes."""
        planes = sum(plane.size for scale in self.scales for plane in scale.values())
        motion = 0 if self.motion is None else self.motion.size
        codes = sum(appearance.code.size for appearance in self.appearances)
        return planes + self.decoder.parameter_count + motion + codes

    def appearance(self, name: str) -> np.ndarray:
        """Return the code of the appearance called `name`, (H,) float32.

        A name may lack its suffix, such as .jpg, where no other appearance has the same name without.

        Raises:
            UsageError: there is none of that name, or there are several; the message lists some that exist.
        """
        for meant in (lambda known: known == name, lambda known: os.path.splitext(known)[0] == name):
            codes = [appearance.code for appearance in self.appearances if meant(appearance.name)]
            if len(codes) == 1:
                return codes[0]
        if not self.appearances:
            raise UsageError(f"appearance {name!r}: the scene has no appearances; render it without one")
        known = first_names([appearance.name for appearance in self.appearances])
        raise UsageError(f"appearance {name!r}: the scene has no such appearance; choose one of {known}")

    def interpolate_appearance(self, first: str, second: str, share: float) -> np.ndarray:
        """Return the code (1 - share) first + share second, (H,) float32, for share in [0, 1].

        Raises:
            UsageError: as `appearance`.
        """
        return np.float32(1 - share) * self.appearance(first) + np.float32(share) * self.appearance(second)
