"""What saves time where many pictures are placed: few points choose the lens, and unmatched views are not sought."""

import json
import subprocess
import sys

import pytest

pytest.importorskip("pycolmap", reason="needs pycolmap, of the extra poses")

# In a process of its own, as `colmap_worker` says.
SCRIPT = """
import json, sys
from pathlib import Path
import pycolmap
from kpc.encoder.poses import colmap_worker, lenses

pycolmap.logging.minloglevel = 2
pycolmap.set_random_seed(0)
file = Path(sys.argv[1]) / "views.db"
options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=8, num_points3D=300)
options.camera_model_id, options.camera_params = pycolmap.CameraModelId.SIMPLE_RADIAL, [1280, 512, 384, -0.1]
with pycolmap.Database.open(file) as database:
    model = pycolmap.synthesize_dataset(options, database)
    apart = pycolmap.Image(name="apart", camera_id=1, image_id=99)
    database.write_image(apart, use_image_id=True)
pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.2), model)
adjusted, counts = lenses._adjust, []
lenses._adjust = lambda tried: (counts.append(tried.num_points3D()), adjusted(tried))
lenses.COMPARED = 600
camera = lenses.with_best_cameras(model, [[0] * 8], "auto").cameras[1]
said = {"counts": counts[:], "model": camera.model_name, "focal": camera.params[0]}
said["views"] = colmap_worker._matching_views(file)
said["cameras"] = len(lenses.with_best_cameras(model, [[0] * 8, [0, 1] * 4], "auto").cameras)
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory) -> dict:
    """What the worker makes of eight views of 300 points, with 2,400 observations, and one view that matches none."""
    command = [sys.executable, "-c", SCRIPT, str(tmp_path_factory.mktemp("many"))]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()[-1])


def test_some_points_choose_the_lens_and_all_adjust_it(said):
    *tried, last = said["counts"]
    assert set(tried) == {75} and len(tried) > 1 and last == 300
    assert said["model"] == "SIMPLE_RADIAL"
    assert said["focal"] == pytest.approx(1280, rel=0.005)


def test_views_that_match_none_are_not_waited_for(said):
    assert said["views"] == 8


def test_cameras_share_a_lens_unless_the_points_speak_against_it(said):
    assert said["cameras"] == 1
