"""Quality of a scene: pictures rendered on the CPU, and their PSNR and SSIM against held-out pictures."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn.functional import conv2d

from kpc.encoder.datasets import Dataset, Pictures, pixel_rays
from kpc.encoder.evaluation.ground_truth import ground_truth
from kpc.encoder.evaluation.moving import MovingPixels
from kpc.encoder.field.appearances import FIT_RAYS, fit_code
from kpc.encoder.field.field import Field
from kpc.encoder.field.fused import count_samples, march_scene, render_rays
from kpc.encoder.field.render import Rays, shade
from kpc.format.common.fidelity import psnr
from kpc.format.common.progress import progress
from kpc.format.scene.scene import AnyDecoder, Decoder, Scene
from kpc.format.scene.space import Contraction

RAYS_AT_ONCE = 1 << 16  # bounds the memory of rendering


class SceneRenderer:
    """Renders rays of a scene with the training kernels.

    The pictures are those of `kpc.player.cpu.reference`, much faster.
    """

    def __init__(self, scene: Scene, field: Field | None = None) -> None:
        """Prepare a scene for rendering.

        Args:
            scene: bounds, occupancy, cameras and background; also the planes and the decoder where `field` is None.
            field: the planes and the decoder, where no scene can hold them (`TrainConfig.summed`).
        """
        self.scene, self.field = scene, field or Field.from_scene(pad_channels(scene))

    def rgb(
        self, origins: np.ndarray, directions: np.ndarray, times: np.ndarray, codes: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the colours of rays, (N, 3) float32; arguments as for `render`."""
        return self.render(origins, directions, times, codes)[0]

    def codes(self, appearances: np.ndarray | None) -> np.ndarray | None:
        """Return the (N, H) appearance embeddings of (N,) indices; None for None."""
        return None if appearances is None else np.stack([a.code for a in self.scene.appearances])[appearances]

    def render(
        self, origins: np.ndarray, directions: np.ndarray, times: np.ndarray, codes: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Render rays.

        Args:
            origins: (N, 3), in the space of the planes (`kpc.encoder.datasets.rays`).
            directions: (N, 3) unit vectors.
            times: (N,) in [0, 1].
            codes: (N, H) appearance embeddings; None for the average appearance.

        Returns:
            Colours (N, 3), opacities (N,) and mean depths (N,) in world units along the rays, all float32.
        """
        draw = self._render_fused if type(self.field) is Field else self._render_composited
        out = []
        for start in range(0, len(origins), RAYS_AT_ONCE):
            some = slice(start, start + RAYS_AT_ONCE)
            o, d, t = (np.ascontiguousarray(a[some], np.float32) for a in (origins, directions, times))
            with torch.no_grad():
                out.append(draw(o, d, t, None if codes is None else torch.from_numpy(codes[some])))
        colours, opacities, depths = (np.concatenate(parts) for parts in zip(*out, strict=True))
        return colours, opacities, depths

    def _render_fused(
        self, o: np.ndarray, d: np.ndarray, t: np.ndarray, codes: torch.Tensor | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return render_rays(self.field, self.scene, self.batch(o, d, t), codes)

    def _render_composited(
        self, o: np.ndarray, d: np.ndarray, t: np.ndarray, codes: torch.Tensor | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        scene = self.scene
        batch = self.batch(o, d, t)
        samples, met = march_scene(self.field, batch, scene)
        along = (
            samples.s.numpy()
            if not isinstance(scene.mapping, Contraction)
            else scene.mapping.distance(samples.s.numpy())
        )
        depths = np.bincount(samples.ray.numpy(), met.weights.numpy() * along, len(o)).astype(np.float32)
        opacities = met.opacity.numpy()
        return shade(self.field, batch, met, codes).numpy(), opacities, depths / np.maximum(opacities, np.float32(1e-6))

    def hits_occupied(self, origins: np.ndarray, directions: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return (N,) bool: whether rays pass through occupied cells. All others show the background."""
        scene = self.scene
        met: np.ndarray = (
            count_samples(
                self.batch(origins, directions, times), scene.aabb, scene.occupancy, scene.step, scene.mapping
            )
            > 0
        )
        return met

    def picture(self, dataset: Dataset, number: int, first: int = 0, code: np.ndarray | None = None) -> np.ndarray:
        """Render the view of a picture of the dataset, with its lens distortion.

        Args:
            dataset: holds the picture's camera and time.
            number: index of the picture.
            first: first column to render.
            code: (H,) appearance embedding; None for the average appearance.

        Returns:
            (height, width - first, 3) float32.
        """
        pictures = dataset.pictures
        h, w = int(pictures.height[number]), int(pictures.width[number]) - first
        row, column = np.divmod(np.arange(w * h), w)
        origins, directions = pixel_rays(pictures, np.full(w * h, number), column + first, row, self.scene.mapping)
        codes = None if code is None else np.tile(code, (w * h, 1))
        return self.rgb(origins, directions, np.full(w * h, pictures.time[number], np.float32), codes).reshape(h, w, 3)

    def fit_left_half(self, dataset: Dataset, number: int) -> np.ndarray:
        """Fit an appearance embedding to at most FIT_RAYS usable pixels of the left half of a picture."""
        pictures, rng = dataset.pictures, np.random.default_rng(number)
        row, column = np.nonzero(dataset.usable(number)[:, : _middle(dataset, number)])
        chosen = rng.permutation(len(row))[:FIT_RAYS]
        row, column, n = row[chosen], column[chosen], len(chosen)
        origins, directions = pixel_rays(pictures, np.full(n, number), column, row, self.scene.mapping)
        batch = self.batch(origins, directions, np.full(n, pictures.time[number]))
        return fit_code(self.scene, self.field, batch, torch.from_numpy(ground_truth(dataset, number)[row, column]))

    def batch(self, origins: np.ndarray, directions: np.ndarray, times: np.ndarray) -> Rays:
        """Return rays as pictures use them: samples in the middle of their steps, on the scene's background."""
        n = len(origins)
        return Rays.from_arrays(origins, directions, times, np.full(n, 0.5), np.tile(self.scene.background, (n, 1)))


def pad_channels(scene: Scene) -> Scene:
    """Return the scene with as many channels at every scale as the widest has, since the kernels take one number.

    Added channels come last, are 0 and have decoder weights of 0, so that the pictures are the same.
    """
    counts = [scale["xy"].shape[2] for scale in scene.scales]
    most = max(counts)
    if min(counts) == most:
        return scene

    def widen(weights: np.ndarray, axis: int) -> np.ndarray:
        parts = np.split(weights, np.cumsum(counts)[:-1], axis=axis)
        return np.concatenate([_pad_axis(part, axis, most) for part in parts], axis=axis)

    d = scene.decoder
    decoder = replace(d, density_weight=widen(d.density_weight, 0), w2=widen(d.w2, 1), b2=widen(d.b2, 1))
    scales = tuple({name: _pad_axis(plane, 2, most) for name, plane in scale.items()} for scale in scene.scales)
    return replace(scene, scales=scales, decoder=decoder)


def unpad_decoder(scene: Scene, decoder: AnyDecoder) -> AnyDecoder:
    """Return the decoder of `pad_channels(scene)` without the added channels."""
    if not isinstance(decoder, Decoder):
        return decoder
    counts = [scale["xy"].shape[2] for scale in scene.scales]
    kept = np.concatenate([np.arange(max(counts)) < count for count in counts])
    return replace(decoder, density_weight=decoder.density_weight[kept], w2=decoder.w2[:, kept], b2=decoder.b2[:, kept])


def _pad_axis(values: np.ndarray, axis: int, size: int) -> np.ndarray:
    return np.pad(values, [(0, size - n if k == axis else 0) for k, n in enumerate(values.shape)])


@dataclass(frozen=True)
class Quality:
    """Means over the pictures that were compared.

    Attributes:
        psnr: of all pixels, dB.
        ssim: of all pixels.
        pictures: how many.
        moving_psnr, still_psnr: of the pixels that move and of the others, dB, over pictures that have any; None where
            that was not measured, or nothing is known to move.
    """

    psnr: float
    ssim: float
    pictures: int
    moving_psnr: float | None = None
    still_psnr: float | None = None


def evaluate(
    scene: Scene,
    dataset: Dataset,
    *,
    most: int | None = None,
    field: Field | None = None,
    label: str | None = None,
    parts: bool = False,
) -> Quality | None:
    """Return the mean PSNR and SSIM over held-out pictures; None where none are held out.

    Pictures with alpha are composited on white, the background that such scenes are stored with. Masked pixels do not
    count, nor does a picture whose mask leaves no window of SSIM.

    Held-out pictures have no appearance embedding of their own. Where the scene has embeddings, one is fitted to the
    left half of each picture and only the right half is scored (K-Planes, section 4.3; the protocol is that of NeRF in
    the Wild, arXiv:2008.02268).

    Args:
        scene: to be rendered.
        dataset: with its held-out pictures.
        most: at most this many pictures, chosen by `spread_evenly`.
        field: as for `SceneRenderer`.
        label: name of the task, to show progress; None to show nothing.
        parts: whether to measure moving and still pixels apart, too.
    """
    held_out = testable_pictures(dataset, right_halves=bool(scene.appearances))
    if len(held_out) == 0:
        return None
    if most is not None:
        held_out = spread_evenly(dataset.pictures, held_out, most)
    renderer = SceneRenderer(scene, field)
    moving = MovingPixels(dataset) if parts else None
    scores: list[tuple[float, float]] = []
    of_parts: dict[str, list[float]] = {"moving": [], "still": []}
    for number in progress(held_out.tolist(), label or "", unit="pictures", shown=label is not None):
        found = compare(renderer, dataset, number)
        scores.append((found.psnr(), ssim(found.picture, found.truth, None if dataset.masks is None else found.usable)))
        if moving is not None:
            for part, chosen in found.parts(moving.mask(number)).items():
                of_parts[part].append(found.psnr(chosen))
    mean_psnr, mean_ssim = np.mean(scores, axis=0)
    quality = Quality(float(mean_psnr), float(mean_ssim), len(scores))
    if not all(of_parts.values()):
        return quality
    moving_psnr, still_psnr = (float(np.mean(of_parts[part])) for part in ("moving", "still"))
    return replace(quality, moving_psnr=moving_psnr, still_psnr=still_psnr)


def training_psnr(scene: Scene, dataset: Dataset, most: int) -> float:
    """Return the mean PSNR in dB over at most `most` pictures that were trained on, spread evenly.

    How far held-out pictures are behind it is how much the model is overfitted. The scene has no appearances.
    """
    trained = spread_evenly(dataset.pictures, np.flatnonzero(~dataset.pictures.is_test), most)
    renderer = SceneRenderer(scene)
    shown = progress(trained.tolist(), "testing on training pictures", unit="pictures")
    return float(np.mean([compare(renderer, dataset, number).psnr() for number in shown]))


@dataclass(frozen=True)
class Comparison:
    """The columns of a picture that count, as they are rendered and as they were filmed.

    Attributes:
        picture, truth: (H, W, 3) float32 in [0, 1], rendered and filmed.
        usable: (H, W) bool, the pixels that count.
        first: the column of the whole picture at which they begin.
    """

    picture: np.ndarray
    truth: np.ndarray
    usable: np.ndarray
    first: int

    @property
    def error(self) -> np.ndarray:
        """The difference of rendered and filmed colours, (H, W, 3) float32."""
        return self.picture - self.truth

    def psnr(self, chosen: np.ndarray | None = None) -> float:
        """Return the PSNR in dB of the usable pixels, or of some (H, W) bool of them."""
        where = self.usable if chosen is None else chosen
        return psnr(self.picture[where], self.truth[where])

    def parts(self, moving: np.ndarray | None) -> dict[str, np.ndarray]:
        """Return the usable pixels that move, "moving", and the others, "still", (H, W) bool, where there are any.

        Args:
            moving: (H, W') bool, the moving pixels of the whole picture (`MovingPixels`); None if they are unknown.
        """
        if moving is None:
            return {}
        mask = moving[:, self.first :]
        found = {"moving": mask & self.usable, "still": ~mask & self.usable}
        return {part: chosen for part, chosen in found.items() if chosen.any()}


def compare(renderer: SceneRenderer, dataset: Dataset, number: int) -> Comparison:
    """Render a picture of the dataset beside what was filmed; `evaluate` says which of its pixels count."""
    first, code = 0, None
    if renderer.scene.appearances:
        first, code = _middle(dataset, number), renderer.fit_left_half(dataset, number)
    picture = np.clip(renderer.picture(dataset, number, first, code), 0, 1)
    truth = ground_truth(dataset, number)[:, first:]
    usable = np.ones(truth.shape[:2], bool) if dataset.masks is None else dataset.usable(number)[:, first:]
    return Comparison(picture, truth, usable, first)


def testable_pictures(dataset: Dataset, right_halves: bool) -> np.ndarray:
    """Return the numbers of the held-out pictures that can be scored: those whose mask leaves a window of SSIM.

    Args:
        dataset: with its held-out pictures.
        right_halves: whether only the right half of each picture is scored.
    """
    held_out = np.flatnonzero(dataset.pictures.is_test)
    if dataset.masks is None:
        return held_out
    starts = [_middle(dataset, number) if right_halves else 0 for number in held_out.tolist()]
    usable = [has_windows(dataset.usable(n)[:, start:]) for n, start in zip(held_out.tolist(), starts, strict=True)]
    return held_out[np.array(usable, bool)]


def spread_evenly(pictures: Pictures, numbers: np.ndarray, count: int) -> np.ndarray:
    """Choose at most `count` of some pictures, spread evenly over cameras and time; the choice is deterministic.

    Each camera gets its share of the pictures. Its own are evenly spaced in time, shifted from camera to camera, so
    that one picture each of several cameras shows different times.

    Args:
        pictures: of the dataset.
        numbers: of the pictures to choose from.
        count: at least 1.
    """
    if count >= len(numbers):
        return numbers
    ordered = numbers[np.lexsort((pictures.time[numbers], pictures.camera[numbers]))]
    _, sizes = np.unique(pictures.camera[ordered], return_counts=True)
    ends = np.cumsum(sizes)
    shares = np.diff((ends * count + len(ordered) // 2) // len(ordered), prepend=0)
    chosen = []
    for k, (end, size, share) in enumerate(zip(ends, sizes, shares, strict=True)):
        places = (np.arange(share) + (k + 0.5) / len(ends)) * size / max(share, 1)
        chosen.append(ordered[end - size + places.astype(int)])
    return np.concatenate(chosen)


def _middle(dataset: Dataset, number: int) -> int:
    """Return the first column of a picture's right half."""
    return int(dataset.pictures.width[number]) // 2


def ssim(a: np.ndarray, b: np.ndarray, usable: np.ndarray | None = None) -> float:
    """Return the structural similarity of two pictures, the mean over pixels and channels.

    Wang et al. 2004, eq. 13: Gaussian window of 11 x 11 with sigma 1.5, K1 = 0.01, K2 = 0.03. Only windows that lie
    inside the picture count; smaller pictures take a smaller window.

    Args:
        a: (H, W, 3) in [0, 1].
        b: (H, W, 3) in [0, 1].
        usable: (H, W) bool; only windows whose central pixel is usable count. They may reach over other pixels.
    """
    size = _window(*a.shape[:2])
    x = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    g = torch.exp(-x.square() / (2 * 1.5**2))
    g = g / g.sum()

    def blur(image: torch.Tensor) -> torch.Tensor:
        return conv2d(conv2d(image, g.view(1, 1, 1, -1)), g.view(1, 1, -1, 1))

    p, q = (torch.from_numpy(np.ascontiguousarray(i.transpose(2, 0, 1)[:, None], np.float64)) for i in (a, b))
    mu_p, mu_q = blur(p), blur(q)
    var_p, var_q, cov = blur(p * p) - mu_p**2, blur(q * q) - mu_q**2, blur(p * q) - mu_p * mu_q
    c1, c2 = 0.01**2, 0.03**2
    values = ((2 * mu_p * mu_q + c1) * (2 * cov + c2)) / ((mu_p**2 + mu_q**2 + c1) * (var_p + var_q + c2))
    if usable is not None:
        values = values[:, 0, torch.from_numpy(_centres(usable))]
    return float(values.mean())


def has_windows(usable: np.ndarray) -> bool:
    """Return whether any window of SSIM counts where only some pixels, (H, W) bool, are usable."""
    return bool(_centres(usable).any())


def _window(height: int, width: int) -> int:
    return min(11, height, width)


def _centres(usable: np.ndarray) -> np.ndarray:
    """Return the part of an (H, W) array that the central pixels of SSIM's windows lie in."""
    height, width = usable.shape
    size = _window(height, width)
    return usable[size // 2 : size // 2 + height - size + 1, size // 2 : size // 2 + width - size + 1]
