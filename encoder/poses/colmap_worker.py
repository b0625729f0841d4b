"""Structure from motion by COLMAP, in a process of its own: `python -m kpc.encoder.poses.colmap_worker FOLDER`.

COLMAP's wheel brings its own zlib, which crashes beside those of other wheels, and cannot be interrupted. The folder
holds `job.json` and pictures as .npy files, which `kpc.encoder.poses.structure` writes; it also reads the result. Lines
of JSON on stdout report progress.

A *view* is a camera at a place: a camera of a still rig, or one picture of a moving camera. It may have pictures of
several instants. Features are matched between pictures of the same instant only, so that what moves can be matched,
too; all matches of two views then count together.
"""

import json
import sys
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from kpc.encoder.poses.lenses import AssumedLens, assumed_lens, is_fisheye, projections, rays, with_best_cameras
from kpc.encoder.poses.matching import alike_pairs, match_pairs, strongest

# Views that a model has at least.
LEAST_VIEWS = 3
# Matches of two views that agree with one geometry count if there are so many, as COLMAP has it.
LEAST_MATCHES = 15
# Matches agree with a geometry to within this share of the larger side of pictures, or a pixel. COLMAP's own 4 pixels
# are so much for large pictures; in small ones, all that a plane shows agrees with wrong geometries, too.
VERIFIED = 0.0025
# Matches confirm a model if they agree with it to within so many times that.
CONFIRMED = 2.0
# Mean distance in pixels between points and where they were found, below which a model of all views is believed.
GOOD_ERROR = 1.0

# Pictures whose features are found between two lines of progress.
BATCH = 16


def main(folder: Path) -> None:
    """Carry out the job of a folder; write `result.json` and `result.npz` there."""
    job = json.loads((folder / "job.json").read_text())
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(job["seed"])
    pictures = _features(folder, job)
    matches = _matches(job, pictures)
    database = folder / "views.db"
    keypoints = _of_views(job, [places for places, _ in pictures])
    sizes = [job["cameras"][view["camera"]]["size"] for view in job["views"]]
    lens, is_contradicted = assumed_lens(keypoints, sizes, matches, _tolerance(max(map(max, sizes))), job["kind"])
    _write_views(database, job, keypoints, matches, lens)
    _verify(database, job)
    model, apart = _reconstruct(folder, database, job, lens)
    found: dict[str, Any] = {"views": {}, "apart": apart, "is_lens_contradicted": is_contradicted}
    arrays: dict[str, Any] = {}
    if model is not None:
        _say("adjusting lenses", 0, 1)
        model = with_best_cameras(model, job["lenses"], job["kind"])
        found["views"], arrays = _views(model), _points(model)
    found["pairs"] = _pairs(database, model)
    np.savez(folder / "result.npz", **arrays)
    (folder / "result.json").write_text(json.dumps(found))


def _say(step: str, done: int, total: int) -> None:
    print(json.dumps({"step": step, "done": done, "total": total}), flush=True)


def _features(folder: Path, job: dict[str, Any]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return for each picture (N, 6) float32 keypoints, x y and a 2 x 2 matrix, and (N, 128) uint8 descriptors."""
    options = pycolmap.FeatureExtractionOptions(num_threads=job["threads"])
    options.sift.max_num_features, options.sift.first_octave = job["features"], job["first_octave"]
    file = folder / "features.db"
    files = [picture["file"] for picture in job["pictures"]]
    for start in range(0, len(files), BATCH):
        pycolmap.extract_features(
            file,
            folder,
            image_names=files[start : start + BATCH],
            camera_mode=pycolmap.CameraMode.PER_IMAGE,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        _say("finding features", min(start + BATCH, len(files)), len(files))
    database = pycolmap.Database.open(file)
    found = []
    for picture in job["pictures"]:
        image = database.read_image_with_name(picture["file"])
        assert image is not None
        number = image.image_id
        places = np.asarray(database.read_keypoints(number), np.float32).reshape(-1, 6)
        used = np.ones(len(places), bool)
        if picture["mask"] is not None:  # (H, W) bool
            mask = np.load(folder / picture["mask"])
            x, y = (places[:, axis].astype(int).clip(0, mask.shape[1 - axis] - 1) for axis in (0, 1))
            used = mask[y, x]
        found.append((places[used] * picture["scale"], np.asarray(database.read_descriptors(number).data)[used]))
    database.close()
    return found


def _matches(job: dict[str, Any], pictures: list[tuple[np.ndarray, np.ndarray]]) -> dict[tuple[int, int], np.ndarray]:
    """Match pictures and merge what belongs to the same two views.

    Returns:
        By pairs of views, (M, 2) uint32 numbers of keypoints, which count on over the pictures of a view.
    """
    features = [descriptors for _, descriptors in pictures]
    starts = _starts(job, [len(descriptors) for descriptors in features])
    found: dict[tuple[int, int], list[np.ndarray]] = {}
    pairs = [*map(tuple, job["pairs"]), *_alike(job, pictures)]
    for number, (pair, matched) in enumerate(match_pairs(features, pairs, job["threads"]), 1):
        views = tuple(job["pictures"][picture]["view"] for picture in pair)
        found.setdefault(views, []).append(matched + np.array([starts[picture] for picture in pair], np.uint32))
        _say("matching", number, len(pairs))
    return {views: np.concatenate(parts) for views, parts in found.items()}


def _alike(job: dict[str, Any], pictures: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[int, int]]:
    """Return pairs of pictures that look alike and are not among those of the job."""
    known = set(map(tuple, job["pairs"]))
    candidates = [pair for pair in combinations(job["compared"], 2) if pair not in known]
    features = [strongest(*picture) for picture in pictures]
    counts = {}
    for number, (pair, matched) in enumerate(match_pairs(features, candidates, job["threads"]), 1):
        counts[pair] = len(matched)
        _say("comparing", number, len(candidates))
    return alike_pairs(counts, job["alike"], job["groups"])


def _starts(job: dict[str, Any], counts: list[int]) -> list[int]:
    """Return for each picture the number of its first keypoint among those of its view."""
    ends: dict[int, int] = {}
    starts = []
    for picture, count in zip(job["pictures"], counts, strict=True):
        starts.append(ends.get(picture["view"], 0))
        ends[picture["view"]] = starts[-1] + count
    return starts


def _of_views(job: dict[str, Any], of_pictures: list[np.ndarray]) -> list[np.ndarray]:
    """Return the keypoints of each view, one picture after another."""
    found: list[list[np.ndarray]] = [[] for _ in job["views"]]
    for picture, keypoints in zip(job["pictures"], of_pictures, strict=True):
        found[picture["view"]].append(keypoints)
    return [np.concatenate(own).astype(np.float32) for own in found]


def _write_views(
    file: Path,
    job: dict[str, Any],
    keypoints: list[np.ndarray],
    matches: dict[tuple[int, int], np.ndarray],
    lens: AssumedLens,
) -> None:
    """Write views, their keypoints and the matches into a new database; numbers count from 1 there."""
    file.unlink(missing_ok=True)
    database = pycolmap.Database.open(file)
    for number, camera in enumerate(job["cameras"], 1):
        model = lens.camera(number, *camera["size"])
        database.write_camera(model, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(model.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for number, view in enumerate(job["views"], 1):
        image = pycolmap.Image(name=view["name"], camera_id=view["camera"] + 1, image_id=number)
        frame = pycolmap.Frame(frame_id=number, rig_id=view["camera"] + 1)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
        image.frame_id = number
        database.write_image(image, use_image_id=True)
        database.write_keypoints(number, keypoints[number - 1])
    for (one, two), pairs in matches.items():
        if len(pairs):
            database.write_matches(one + 1, two + 1, pairs)
    database.close()


def _verify(database: Path, job: dict[str, Any]) -> None:
    """Find which matches of two views agree with one geometry."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job["seed"]
    largest = max(max(camera["size"]) for camera in job["cameras"])
    options.ransac.max_error = _tolerance(largest)
    pycolmap.geometric_verification(
        database, pycolmap.GeometricVerifierOptions(num_threads=job["threads"]), two_view_geometry_options=options
    )


def _pairs(file: Path, model: pycolmap.Reconstruction | None) -> list[tuple[int, int, int, int, float | None]]:
    """Describe the matches of each two views.

    Returns:
        Numbers of the views, the matches, those that agree with one geometry, and the share of these that agree with
        where the model has the views; None if it lacks one of them, or nothing agrees.
    """
    database = pycolmap.Database.open(file)
    agreeing = dict(zip(*database.read_two_view_geometry_num_inliers(), strict=True))
    placed = set() if model is None else set(model.reg_image_ids())
    found = []
    for pair, count in zip(*database.read_num_matches(), strict=True):
        one, two = pycolmap.pair_id_to_image_pair(pair)
        share = None
        if model is not None and agreeing.get(pair) and placed.issuperset((one, two)):
            matches = database.read_two_view_geometry(one, two).inlier_matches
            share = _confirmed(
                model, one, two, *(_places(database, n, matches[:, k]) for k, n in enumerate((one, two)))
            )
        found.append((one - 1, two - 1, count, agreeing.get(pair, 0), share))
    database.close()
    return found


def _places(database: pycolmap.Database, number: int, features: np.ndarray) -> np.ndarray:
    """Return where numbered features of a view lie, (M, 2) float64 pixels."""
    return np.asarray(database.read_keypoints(number), np.float64)[features, :2]


def _confirmed(model: pycolmap.Reconstruction, one: int, two: int, in_one: np.ndarray, in_two: np.ndarray) -> float:
    """Return the share of matches that lie on each other's epipolar lines, by Sampson's distance, (M, 2) pixels."""
    images = [model.images[number] for number in (one, two)]
    cameras = [model.cameras[image.camera_id] for image in images]
    a, b = (rays(camera, at) for camera, at in zip(cameras, (in_one, in_two), strict=True))
    axes = 3 if is_fisheye(cameras[0]) else 2  # in which a place deviates: of a sphere, or of a plane
    relative = (images[1].cam_from_world() * images[0].cam_from_world().inverse()).matrix()
    x, y, z = relative[:, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:, :3]
    lines_two, lines_one = a @ essential.T, b @ essential
    slopes = np.square(lines_one[:, :axes]).sum(1) + np.square(lines_two[:, :axes]).sum(1)
    distance = np.abs((b * lines_two).sum(1)) / np.sqrt(np.maximum(slopes, 1e-24))
    focal = min(camera.mean_focal_length() for camera in cameras)
    return float((distance * focal <= CONFIRMED * _tolerance(max(max(c.width, c.height) for c in cameras))).mean())


def _tolerance(largest: int) -> float:
    """Return how far matches may be from a geometry, in pixels, in pictures of such a larger side."""
    return max(VERIFIED * largest, 1.0)


def _reconstruct(
    folder: Path, database: Path, job: dict[str, Any], lens: AssumedLens
) -> tuple[pycolmap.Reconstruction | None, list[int]]:
    """Place the views all at once, and one after another where that leaves out some that match others.

    Focal lengths of pinholes are estimated from pairs of views first: with COLMAP's assumption alone, rigs of few views
    end in a wrong one.

    Returns:
        The better model, and the views that another one has and it has not, by their numbers.
    """
    output = folder / "models"
    output.mkdir(exist_ok=True)
    if not lens.is_fisheye:
        pycolmap.calibrate_view_graph(database)
    total, models = _matching_views(database), []
    for number, mapper in enumerate((_map_globally, _map_incrementally)):
        _say("placing cameras", number, 2)
        models += [model for model in mapper(folder, database, output, job) if model.num_reg_images() >= LEAST_VIEWS]
        best = max(models, key=lambda model: (model.num_reg_images(), -_mean_error(model)), default=None)
        if best is not None and best.num_reg_images() >= total and _mean_error(best) < GOOD_ERROR:
            break
    placed = set() if best is None else set(best.reg_image_ids())
    others = [set(model.reg_image_ids()) - placed for model in models]
    apart = max((other for other in others if len(other) >= LEAST_VIEWS), key=len, default=set[int]())
    return best, sorted(number - 1 for number in apart)


def _matching_views(file: Path) -> int:
    """Return how many views have matches with another that agree with one geometry: only these can be placed."""
    database = pycolmap.Database.open(file)
    agreeing = zip(*database.read_two_view_geometry_num_inliers(), strict=True)
    found = {
        view for pair, count in agreeing if count >= LEAST_MATCHES for view in pycolmap.pair_id_to_image_pair(pair)
    }
    database.close()
    return len(found)


def _map_globally(folder: Path, database: Path, output: Path, job: dict[str, Any]) -> list[pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions(num_threads=job["threads"], random_seed=job["seed"])
    if job["tracks"] is not None:
        options.mapper.track_required_tracks_per_view = job["tracks"]
    return list(pycolmap.global_mapping(database, folder, output, options).values())


def _map_incrementally(
    folder: Path, database: Path, output: Path, job: dict[str, Any]
) -> list[pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions(
        min_model_size=LEAST_VIEWS, num_threads=job["threads"], random_seed=job["seed"], extract_colors=False
    )
    return list(pycolmap.incremental_mapping(database, folder, output, options).values())


def _mean_error(model: pycolmap.Reconstruction) -> float:
    return float(model.compute_mean_reprojection_error())


def _views(model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Describe the placed views by their numbers."""
    found = {}
    for number in model.reg_image_ids():
        image = model.images[number]
        camera = model.cameras[image.camera_id]
        errors = [float(np.hypot(*(seen - projected))) for seen, projected in projections(model, image)]
        found[str(number - 1)] = {
            "camera_from_world": image.cam_from_world().matrix().tolist(),
            "model": camera.model_name,
            "parameters": dict(zip(camera.params_info.split(", "), map(float, camera.params), strict=True)),
            "points": len(errors),
            "error": float(np.mean(errors)) if errors else None,
        }
    return found


def _points(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """Return points (N, 3) float64 and, for each time that one is seen, its number, the view, x and y (M, 4)."""
    points = list(model.points3D.values())
    seen = [
        (number, element.image_id - 1, *model.images[element.image_id].points2D[element.point2D_idx].xy)
        for number, point in enumerate(points)
        for element in point.track.elements
    ]
    return {
        "points": np.array([point.xyz for point in points]).reshape(-1, 3),
        "observations": np.array(seen, np.float64).reshape(-1, 4),
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))
