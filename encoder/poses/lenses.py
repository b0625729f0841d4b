"""The lenses of views: which to assume while views are placed, and which camera model their points speak for."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, product
from typing import NamedTuple

import numpy as np
import pycolmap

from kpc.format.scene.camera_models import FISHEYE_MODELS

# Camera models in the order in which they are tried, by their parameters beside the principal point; fisheye ones only
# where a corner of a picture lies so many degrees or more from the axis.
PINHOLES = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYES = ("SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
WIDE = 40.0

# A camera model with more parameters is taken if it lowers n log(sum of squared errors) by so many times log(n) for
# each: the Bayesian information criterion has 1, but errors of one point in many views are not independent.
EVIDENCE = 4.0

# An adjustment ends once a step lowers the cost by less than this share: COLMAP's own default takes four times as long
# for the same result.
TOLERANCE = 1e-6

# Camera models are compared on about so many observations of points.
COMPARED = 100_000

# A fisheye lens is assumed if so many times as many matches agree with it as with a pinhole, among some matches of some
# pairs of views: those between which most moves, of the ones with many matches. Fisheye lenses reached 1.09 to 1.28
# times, 1.03 in a clip, pinholes 0.72 to 0.98, and 1.01 with barrel distortion.
CLEARLY, PROBED_PAIRS, PROBED_MATCHES, MANY_MATCHES, PROBING_TRIALS = 1.02, 12, 500, 100, 1000


class AssumedLens(NamedTuple):
    """A lens that is assumed before anything is known.

    Attributes:
        model: name of the camera model.
        focal: focal length over the larger side of the picture.
    """

    model: str
    focal: float

    @property
    def is_fisheye(self) -> bool:
        return self.model in FISHEYE_MODELS

    def camera(self, number: int, width: int, height: int) -> pycolmap.Camera:
        """Return a camera with this lens, whose focal length is that of a fisheye to begin with, else anything."""
        camera = pycolmap.Camera.create_from_model_name(
            number, self.model, self.focal * max(width, height), width, height
        )
        camera.has_prior_focal_length = self.is_fisheye
        return camera


# The focal length that COLMAP assumes; and those of fisheye lenses from 280 to 90 degrees across.
PINHOLE = AssumedLens("SIMPLE_RADIAL", 1.2)
FISHEYE_LENSES = tuple(AssumedLens("SIMPLE_RADIAL_FISHEYE", focal) for focal in (0.2, 0.26, 0.33, 0.4, 0.5, 0.64))


class LensChoice(NamedTuple):
    """Which lens is assumed, and whether clearly more matches agree with one of the other kind."""

    lens: AssumedLens
    is_contradicted: bool


def assumed_lens(
    keypoints: Sequence[np.ndarray],
    sizes: Sequence[tuple[int, int]],
    matches: Mapping[tuple[int, int], np.ndarray],
    tolerance: float,
    kind: str,
) -> LensChoice:
    """Return the lens with which most matches agree: a pinhole, or a fisheye lens if that is clearly better.

    One of the kind that the user names is assumed though matches may contradict it.

    Those of a pinhole agree with a fundamental matrix, whatever its focal length; those of a fisheye lens with an
    essential matrix, if its focal length is about right.

    Args:
        keypoints: of each view, (N, 2 or more) float32 pixels first.
        sizes: width and height of each view's pictures.
        matches: of pairs of views, (M, 2) numbers of keypoints.
        tolerance: pixels that a match may be off.
        kind: one of `wishes.LENSES`: of what kind the lens is.
    """
    options = pycolmap.RANSACOptions(max_error=tolerance, max_num_trials=PROBING_TRIALS, random_seed=0)

    def places(pair: tuple[int, int]) -> list[np.ndarray]:
        """Return where some of the matches are in the two views, (M, 2) float64 each."""
        chosen = matches[pair][:: max(1, len(matches[pair]) // PROBED_MATCHES)]
        return [keypoints[view][chosen[:, k], :2].astype(np.float64) for k, view in enumerate(pair)]

    def moved(pair: tuple[int, int]) -> float:
        a, b = places(pair)
        return float(np.median(np.linalg.norm(b - a, axis=1)))

    # Neighbouring frames of a clip agree with any lens, so that it needs pairs of views that are far apart.
    strongest = sorted(matches, key=lambda pair: (-len(matches[pair]), pair))
    usable = [pair for pair in strongest if len(matches[pair]) >= MANY_MATCHES]
    if len(usable) < PROBED_PAIRS:
        usable = [pair for pair in strongest[:PROBED_PAIRS] if len(matches[pair])]
    probed = [(pair, places(pair)) for pair in sorted(usable, key=moved, reverse=True)[:PROBED_PAIRS]]

    def agreeing(lens: AssumedLens) -> int:
        count = 0
        for (first, second), (a, b) in probed:
            if lens.is_fisheye:
                one, two = lens.camera(1, *sizes[first]), lens.camera(2, *sizes[second])
                found = pycolmap.estimate_essential_matrix(a, b, one, two, options)
            else:
                found = pycolmap.estimate_fundamental_matrix(a, b, options)
            count += 0 if found is None else int(found["num_inliers"])
        return count

    counts = {lens: agreeing(lens) for lens in (PINHOLE, *FISHEYE_LENSES)}
    best = max(FISHEYE_LENSES, key=counts.__getitem__)
    if kind == "fisheye" or (kind == "auto" and counts[best] > CLEARLY * counts[PINHOLE]):
        return LensChoice(best, counts[PINHOLE] > CLEARLY * counts[best])
    return LensChoice(PINHOLE, counts[best] > CLEARLY * counts[PINHOLE])


def is_fisheye(camera: pycolmap.Camera) -> bool:
    """Return whether a camera's model is a fisheye model."""
    return camera.model_name in FISHEYE_MODELS


def rays(camera: pycolmap.Camera, places: np.ndarray) -> np.ndarray:
    """Return directions in the camera's frame through places (N, 2) in its picture: (N, 3), of depth 1 or length 1.

    Those of a fisheye lens have length 1, since it may see what lies beside and behind it.
    """
    if is_fisheye(camera):
        return np.asarray(camera.cam_ray_from_img(places))
    return np.pad(camera.cam_from_img(places), ((0, 0), (0, 1)), constant_values=1.0)


def with_best_cameras(model: pycolmap.Reconstruction, lenses: list[list[int]], kind: str) -> pycolmap.Reconstruction:
    """Return the model adjusted with the cameras that its points speak for: how many parameters, shared or not.

    If there are many more than COMPARED observations, some of the points choose the cameras, and then all count.

    Args:
        model: as it was placed.
        lenses: the number of each view's lens, in each way that is tried, from the fewest lenses on.
        kind: one of `wishes.LENSES`: of what kind they are.
    """
    best, chosen, least = model, ("", lenses[0]), np.inf
    every = max(1, round(model.compute_num_observations() / COMPARED))
    families = {"pinhole": (PINHOLES,), "fisheye": (FISHEYES,)}.get(kind, (PINHOLES, FISHEYES))
    if kind == "auto" and not _are_wide(model):
        families = (PINHOLES,)
    for some, family in product(lenses, families):
        for name in family:
            tried = _with_cameras(model, name, some, every)
            _adjust(tried)
            measure = _criterion(tried)
            if measure < least:
                best, chosen, least = tried, (name, some), measure
            elif name != family[0]:
                break  # more parameters do not help
    if every == 1 or not np.isfinite(least):
        return best
    whole = _with_cameras(model, *chosen)
    for number, camera in best.cameras.items():
        whole.cameras[number].params = camera.params
    _adjust(whole)
    return whole


def _adjust(model: pycolmap.Reconstruction) -> None:
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.function_tolerance = TOLERANCE
    pycolmap.bundle_adjustment(model, options)


def _criterion(model: pycolmap.Reconstruction) -> float:
    """Return n log(mean squared error) + EVIDENCE k log(n) of n coordinates and k parameters of cameras."""
    if any(camera.has_bogus_params(0.1, 10.0, 1.0) for camera in model.cameras.values()):
        return np.inf
    errors = _errors(model)
    parameters = sum(len(camera.params) - 2 for camera in model.cameras.values())  # but the principal point
    count = 2 * len(errors)
    return float(count * np.log((errors**2).mean()) + EVIDENCE * parameters * np.log(count))


def _with_cameras(
    model: pycolmap.Reconstruction, name: str, lenses: list[int], every: int = 1
) -> pycolmap.Reconstruction:
    """Return a copy with other camera models, which begin with the focal length found and without distortion.

    Args:
        model: what is copied.
        name: of the camera model.
        lenses: the number of each view's lens.
        every: the copy has one of so many points.
    """
    copy = pycolmap.Reconstruction()
    cameras: set[int] = set()
    for number in model.reg_image_ids():
        image = model.images[number]
        key = lenses[number - 1] + 1
        if key not in cameras:
            own = model.cameras[image.camera_id]
            camera = pycolmap.Camera.create_from_model_name(key, name, own.mean_focal_length(), own.width, own.height)
            copy.add_camera_with_trivial_rig(camera)
            cameras.add(key)
        places = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        copied = pycolmap.Image(name=image.name, keypoints=places, camera_id=key, image_id=number)
        copy.add_image_with_trivial_frame(copied, image.cam_from_world())
    for point in islice(model.points3D.values(), 0, None, every):
        copy.add_point3D(point.xyz, point.track)
    return copy


def _errors(model: pycolmap.Reconstruction) -> np.ndarray:
    """Return the distance in pixels of each observation from its projected point."""
    return np.array(
        [
            np.hypot(*(observed - projected))
            for number in model.reg_image_ids()
            for observed, projected in projections(model, model.images[number])
        ]
    )


def projections(model: pycolmap.Reconstruction, image: pycolmap.Image) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for point in image.get_observation_points2D():
        projected = image.project_point(model.points3D[point.point3D_id].xyz)
        if projected is not None:
            yield point.xy, projected


def _are_wide(model: pycolmap.Reconstruction) -> bool:
    """Return whether a camera sees so much that its lens may be a fisheye: WIDE degrees from the axis, or more.

    A pinhole whose distortion cannot be undone at the corner has no ray there, and may be one, too.
    """
    corners = [rays(camera, np.zeros((1, 2)))[0] for camera in model.cameras.values()]
    return not all(ray[2] > np.cos(np.radians(WIDE)) * np.linalg.norm(ray) for ray in corners)
