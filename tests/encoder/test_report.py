"""The closing lines of kpenc."""

from pathlib import Path

import pytest

from kpc.encoder.cli.options import Options
from kpc.encoder.cli.report import describe_overfitting, print_result

RESULT = {
    "test_psnr": 30.0, "test_psnr_moving": 25.125, "test_psnr_still": 33.0, "test_ssim": 0.9, "test_pictures": 4,
    "held_out_pictures": 30, "appearances": 0, "size_bytes": 5000, "bits_per_parameter": 0.5, "parameters": 80000,
    "coding_loss_db": 0.1, "trade": "max_loss_db", "target": 0.15, "evaluated_on": "training views",
    "validation_loss_db": 0.1, "agreement_db": 40.0, "identity_share": None, "encode_s": 100.0, "train_s": 50.0,
    "coding_s": 20.0, "steps": 300, "refine": "none",
}  # fmt: skip


@pytest.mark.parametrize("coding_s, why", [(20.0, False), (60.0, True)])
def test_the_closing_lines(capsys: pytest.CaptureFixture[str], coding_s: float, why: bool) -> None:
    print_result(RESULT | {"coding_s": coding_s}, Options(Path("clip"), Path("out.kpc")), as_json=False)
    out = capsys.readouterr().out
    assert out.startswith("out.kpc: held-out PSNR 30.00 dB (moving 25.12, still 33.00), SSIM 0.9000 over 4 of 30 pic")
    assert f"of which training 50 s (300 steps) and coding {coding_s:.0f} s; the rest is reading" in out
    assert ("coding took longer than training" in out and "all 80,000 parameters are coded" in out) == why


@pytest.mark.parametrize("start, shared", [(14, True), (16, False)])
def test_pictures_of_frames_that_groups_share_are_said_to_count_twice(
    capsys: pytest.CaptureFixture[str], start: int, shared: bool
) -> None:
    groups = [{"frames": frames, "size_bytes": 2500, "test_psnr": 30.0} for frames in ([0, 15], [start, 29])]
    print_result(RESULT | {"groups": groups}, Options(Path("clip"), Path("out.kpc")), as_json=False)
    assert ("4 of 30 pictures (those of frames that two groups share count twice)" in capsys.readouterr().out) == shared


def test_held_out_pictures_far_behind_those_trained_on_are_a_warning() -> None:
    assert describe_overfitting(27.0, 30.0) == "" and describe_overfitting(30.0, 27.0) == ""
    assert "held-out pictures are 4.1 dB behind those trained on (31.0 dB)" in describe_overfitting(26.9, 31.0)
