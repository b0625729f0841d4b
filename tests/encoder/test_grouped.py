"""`kpenc --group`: the frames of each group, its start from the one before, and resumed runs."""

import json
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import datasets as make
from kpc.encoder.cli import encode_groups, kpenc, prepare
from kpc.encoder.cli.encode_groups import plan_groups
from kpc.encoder.cli.estimate import Estimate
from kpc.encoder.cli.grouped import (
    CLIP_BYTES,
    LATER_STEPS,
    OVERLAP,
    initialise_from,
    options_of_group,
    split_into_spans,
)
from kpc.encoder.cli.options import Options
from kpc.encoder.cli.prepare import prepare_setting, prepare_trainer
from kpc.encoder.datasets import Dataset, load_dataset, loading
from kpc.encoder.field.config import PRESETS
from kpc.encoder.field.field import Field
from kpc.encoder.field.layout import Layout
from kpc.encoder.rdo.rate_control import Trade
from kpc.encoder.training.moving_area import MovingArea
from kpc.encoder.training.train import Trainer
from kpc.format.common.errors import DatasetError, TrainingError, UsageError
from kpc.format.container import scene_io
from kpc.format.container.container import ENTRY, HEADER
from kpc.format.container.groups import Groups, Span, Timeline
from kpc.format.scene.scene import Clip
from kpc.tools.bench import group_joins
from kpc.tools.cli import kpjoin
from training_runs import BOX, TINY

pytestmark = pytest.mark.usefixtures("one_thread", "quick_coding", "rounded", "tiny")
FRAMES = 26


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setitem(PRESETS, "draft", TINY)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """26 frames at 8 fps: three groups of 1.2 s."""
    folder = tmp_path_factory.mktemp("videos")
    make.write_n3dv(folder, cameras=3, frames=FRAMES, width=16, height=12)
    return folder


@pytest.fixture(scope="module")
def clip(videos: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(videos, tmp_path_factory.mktemp("cache"), progress=False)


def encode(videos: Path, output: Path, *options: str) -> int:
    return kpenc.main([str(videos), "-o", str(output), "--preset", "draft", "--group", "1.2s", *options])


def test_groups_are_about_equally_long_and_share_frames():
    spans = split_into_spans(Clip(100, 10.0), 2.5)
    assert spans == (Span(0, 27), Span(23, 29), Span(48, 29), Span(73, 27))
    timeline = Timeline(spans, 10.0)
    assert [timeline.at(frame / 99)[0] for frame in range(100)] == [frame // 25 for frame in range(100)]
    for frames in (26, 29, 300, 301):
        cut = split_into_spans(Clip(frames, 10.0), 2.5)
        shown = [Timeline(cut, 10.0).at(frame / (frames - 1))[0] for frame in range(frames)]
        assert cut[0].start == 0 and cut[-1].last == frames - 1 and max(np.bincount(shown)) <= 25
        assert np.ptp(np.bincount(shown)) <= 1
    assert split_into_spans(Clip(20, 10.0), 2.5) == (Span(0, 20),)
    with pytest.raises(UsageError, match=r"at least 0\.8s"):
        split_into_spans(Clip(100, 10.0), 0.3)


def test_size_and_time_are_divided_among_groups():
    spans = split_into_spans(Clip(100, 10.0), 2.5)
    options = Options(Path("a"), Path("b"), time_budget_s=100.0, trade=Trade(target_bytes=100_000))
    shares = [options_of_group(options, number, spans) for number in range(4)]
    assert sum(share.trade.target_bytes for share in shares) == pytest.approx(
        100_000 - HEADER.size - 5 * ENTRY.size - CLIP_BYTES, abs=4
    )
    assert sum(share.time_budget_s for share in shares) == pytest.approx(100)
    assert shares[1].time_budget_s / shares[0].time_budget_s == pytest.approx(LATER_STEPS * 29 / 27)
    plain = options_of_group(replace(options, trade=Trade(quality=50), time_budget_s=None), 1, spans)
    assert plain.trade == Trade(quality=50) and plain.time_budget_s is None


def test_a_field_starts_from_the_last_row_of_another():
    def field(rows: int, seed: int) -> Field:
        layout = Layout.of(np.array([[5, 4, 3, rows]]), 2)
        made = Field(layout, 4, torch.Generator().manual_seed(seed), (rows, 2, 2, 2))
        with torch.no_grad():
            for value in made.parameters():
                value += torch.rand(value.shape, generator=torch.Generator().manual_seed(seed + 9))
        return made

    earlier, later = field(6, 0), field(4, 1)
    occupancy = np.ones((1, 2, 2, 2), bool)
    scene = earlier.to_scene(np.array([[0, 0, 0], [1, 1, 1]], np.float32), Clip(12, 8.0), occupancy, np.ones(3), 0.1)
    initialise_from(later, scene)
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(3))
    at_the_end = earlier.features(points, torch.ones(20))
    for time in (0.0, 0.4, 1.0):
        assert torch.allclose(later.features(points, torch.full((20,), time)), at_the_end, atol=1e-5)
    assert torch.equal(later.density, earlier.density) and torch.equal(later.w2, earlier.w2)
    assert later.theta.requires_grad and later.theta.is_leaf


def test_a_field_with_an_area_starts_from_another_of_its_layout():
    """Those texels of the planes of the whole box are taken that the area holds."""
    spans = np.array([[[0, 6], [0, 5], [0, 4]], [[3, 5], [2, 6], [0, 7]]])

    def field(rows: int, seed: int) -> Field:
        layout = Layout.of(np.array([[6, 5, 4, 0], [12, 10, 8, rows]]), 2, spans)
        made = Field(layout, 4, torch.Generator().manual_seed(seed))
        with torch.no_grad():
            made.theta += torch.rand(made.theta.shape, generator=torch.Generator().manual_seed(seed + 9))
        made.restore_fixed()
        return made

    earlier, later = field(6, 0), field(4, 1)
    scene = earlier.to_scene(BOX, Clip(12, 8.0), np.ones((1, 2, 2, 2), bool), np.ones(3), 0.1)
    initialise_from(later, scene)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(3))
    at_the_end = earlier.features(points, torch.ones(50))
    for time in (0.0, 1.0):
        assert torch.allclose(later.features(points, torch.full((50,), time)), at_the_end, atol=1e-5)


def test_later_groups_start_with_all_scales(tmp_path):
    make.write_blender(tmp_path / "set")
    options = Options(tmp_path / "set", tmp_path / "out.kpc", preset="draft", box=((-1, -1, -1), (1, 1, 1)))
    setting = prepare_setting(options)
    first = prepare_trainer(options, setting)
    later = prepare_trainer(options, replace(setting, before=first.scene()))
    assert first.config.coarse_until > 0 and later.config == replace(first.config, coarse_until=0.0)
    assert torch.equal(later.field.density, first.field.density)


def test_a_range_of_frames_is_a_dataset(clip):
    some = clip.frame_range(7, 19)
    assert some.clip == Clip(13, clip.clip.fps) and len(some.pictures) == 3 * 13 and some.is_dynamic
    assert np.allclose(np.unique(some.pictures.time), np.arange(13) / 12, atol=1e-6)
    for picture in (0, 20, 38):
        frame = 7 + round(float(some.pictures.time[picture]) * 12)
        twin = int(some.pictures.camera[picture]) * FRAMES + frame
        assert some.pictures.file[picture] == clip.pictures.file[twin]
        assert np.array_equal(some.pixels.picture(picture), clip.pixels.picture(twin))
        first = some.pictures.offset[picture : picture + 1]
        assert np.array_equal(some.pixels.read(first), clip.pixels.read(clip.pictures.offset[twin : twin + 1]))
    with pytest.raises(DatasetError, match="no training picture"):
        clip.frame_range(FRAMES + 3, FRAMES + 9)


def test_a_clip_with_fewer_frames(clip):
    thin = clip.subsample_frames(5)
    assert thin.clip.frame_count == 5 and len(thin.pictures) == 15
    assert thin.clip.duration_s == pytest.approx(clip.clip.duration_s, rel=0.3)
    assert np.allclose(np.unique(thin.pictures.time), np.rint(np.linspace(0, 25, 5)) / 25, atol=1e-6)
    assert clip.subsample_frames(FRAMES) is clip


def test_masks_of_some_pictures(tmp_path):
    make.write_colmap(tmp_path / "set", model="PINHOLE")
    for k in range(10):
        make.write_mask(tmp_path / f"set/masks/{k:04d}.png.png", np.arange(32) + np.zeros((24, 1)) > 3 * k)
    masks = load_dataset(tmp_path / "set", tmp_path / "cache", progress=False).masks
    numbers = np.array([7, 2, 5])
    some = masks.subset(numbers)
    assert np.array_equal(some.counts, masks.counts[numbers])
    for k, number in enumerate(numbers):
        assert np.array_equal(some.usable(k), masks.usable(int(number)))
        rank = np.arange(0, some.counts[k], 37)
        assert np.array_equal(
            some.nth_usable(np.full(len(rank), k), rank), masks.nth_usable(np.full(len(rank), number), rank)
        )


def test_a_long_clip_becomes_a_file_of_groups(videos, tmp_path, capsys):
    output = tmp_path / "long.kpc"
    assert encode(videos, output, "--json", "--test-views", "all") == 0
    out, err = capsys.readouterr()
    result, opened = json.loads(out), Groups(output)
    assert opened.timeline.spans == split_into_spans(Clip(FRAMES, 8.0), 1.2) and len(opened) == 3
    assert [group["frames"] for group in result["groups"]] == [
        [span.start, span.last] for span in opened.timeline.spans
    ]
    assert result["steps"] == 24 * (1 + 2 * LATER_STEPS) and result["size_bytes"] == output.stat().st_size
    assert 5 < result["test_psnr"] < 60
    assert result["test_pictures"] == result["held_out_pictures"] == FRAMES + 4 * OVERLAP
    assert (
        all(f"group {number} of 3" in err for number in range(3))
        and err.count("starts where the one before ended") == 2
    )
    boxes = [opened.open(number).head.aabb for number in range(3)]
    assert np.array_equal(boxes[0], boxes[1]) and np.array_equal(boxes[0], boxes[2])
    assert list(tmp_path.iterdir()) == [output]
    found = group_joins.measure(output, load_dataset(videos, tmp_path / "cache", progress=False))
    assert [frame["frame"] for frame in found["frames"]] == list(range(FRAMES))
    assert [join["frame"] for join in found["joins"]] == [8, 17] and all(
        5 < join["agreement_db"] < 100 for join in found["joins"]
    )
    assert np.mean([frame["psnr"] for frame in found["frames"]]) == pytest.approx(result["test_psnr"], abs=0.5)


def test_groups_share_the_area_in_which_things_move(videos, tmp_path, monkeypatch, capsys):
    """It is found once, on the frames of all groups."""
    searched = []

    def found(dataset: Dataset, aabb: np.ndarray, mapping: None) -> tuple[MovingArea, str]:
        searched.append(dataset.clip.frame_count)
        return MovingArea(
            (0.3, 0.3, 0.2, 0.8, 0.9, 0.7), np.linspace(0, 1, 3), np.ones((3, 64, 64, 64), bool)
        ), "so it is"

    monkeypatch.setattr(prepare, "find_moving_area", found)
    output = tmp_path / "long.kpc"
    assert encode(videos, output, "--layers", "auto") == 0
    assert searched == [FRAMES] and capsys.readouterr().err.count("layers:") == 1
    opened = Groups(output)
    shapes = [
        [scale["xy"].symbols.shape[:2] for scale in scene_io.read(opened.open(number)).scales] for number in range(3)
    ]
    assert len(shapes[0]) == 4 and shapes[0] == shapes[1] == shapes[2]
    first, *others = (scene_io.read(opened.open(number)) for number in range(3))
    for other in others:  # what stands still is that of the first group
        for s in (0, 2):
            assert np.array_equal(other.scales[s]["xy"].symbols, first.scales[s]["xy"].symbols)
        assert not np.array_equal(other.scales[3]["xy"].symbols, first.scales[3]["xy"].symbols)
    shared = len(opened.reader.beside)  # but for those of few bytes
    assert shared and [len(opened.open(number).beside) for number in range(3)] == [shared] * 3
    smaller = tmp_path / "small.kpc"
    assert kpenc.main([str(output), "-o", str(smaller), "--quality", "20", "--tune-steps", "0"]) == 0
    again = Groups(smaller)
    assert [len(again.open(number).beside) for number in range(3)] == [len(again.reader.beside)] * 3
    assert again.reader.beside and smaller.stat().st_size < output.stat().st_size


def test_an_interrupted_run_resumes_in_its_group_to_the_same_file(videos, tmp_path, monkeypatch, capsys):
    every = "--test-views", "all"  # the file says what was measured, and how many are tested depends on the time
    assert encode(videos, tmp_path / "whole.kpc", *every) == 0
    begun: list[Trainer] = []
    make_trainer = Trainer.__init__

    def init(self: Trainer, *args: object, **named: object) -> None:
        make_trainer(self, *args, **named)  # type: ignore[arg-type]
        begun.append(self)
        step = self.optimiser.step

        def stepping(count: int, *rest: object) -> tuple[float, float]:
            if len(begun) == 2 and count == 3:
                os.kill(os.getpid(), signal.SIGINT)
            return step(count, *rest)  # type: ignore[arg-type]

        self.optimiser.step = stepping  # type: ignore[method-assign]

    output = tmp_path / "long.kpc"
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "__init__", init)
        assert encode(videos, output, *every) == 130
    err = capsys.readouterr().err
    assert "stopped at step 4" in err and "group-0001" in err and not output.exists()
    assert encode(videos, output, *every, "--resume", "--seed", "5", "--title", "Zwölf") == 1
    assert "other settings (--seed was 0, is 5, --title was the default, is Zwölf)" in capsys.readouterr().err
    assert encode(videos, output, *every, "--resume") == 0
    err = capsys.readouterr().err
    assert "group-0000.kpc: is finished already" in err and "resumed at step 4" in err and "nothing to" not in err
    assert output.read_bytes() == (tmp_path / "whole.kpc").read_bytes()


def test_that_there_is_nothing_to_resume_is_said_before_the_dataset_is_read(tmp_path, capsys):
    assert encode(tmp_path, tmp_path / "long.kpc", "--resume") == 1  # there are no videos
    first = f"{tmp_path / 'long.kpc.work'}: there is nothing to resume; starting afresh\n"
    assert capsys.readouterr().err.startswith(first)


def test_finished_groups_may_have_another_length_but_no_other_options(tmp_path, capsys):
    """As the checkpoint of a single scene and its continuation."""
    path, measured = tmp_path / "group-0000.kpc", (*encode_groups.GROUP_FIGURES, *encode_groups.SUMMED_FIGURES)
    found = dict.fromkeys((*measured, "test_psnr_moving", "refine"), 1)
    before = Options(tmp_path, tmp_path / "a.kpc", steps=40)
    path.with_suffix(".json").write_text(json.dumps({"options": encode_groups._fingerprint(before), "found": found}))
    for options, said in (
        (before, "is finished already\n"),
        (replace(before, steps=60), "as long as it was trained (--steps 40 before, --steps 60 now)\n"),
        (replace(before, steps=None, time_budget_s=7.0), "(--steps 40 before, --time-budget 7s of this group now)\n"),
    ):
        assert encode_groups._read_finished(path, options) == found
        err = capsys.readouterr().err
        assert err.startswith(f"{path}: is finished already") and err.endswith(said)
    with pytest.raises(TrainingError, match=r"other settings \(--tune-steps was the default, is 5\), and all groups"):
        encode_groups._read_finished(path, replace(before, steps=60, tune_steps=5))
    with pytest.raises(TrainingError, match=r"\(--group was the default, is 2s\)"):
        encode_groups._read_finished(path, replace(before, group_s=2.0))


@pytest.mark.usefixtures("searched")
def test_a_clip_is_coded_anew_group_by_group(videos, tmp_path, capsys):
    assert encode(videos, tmp_path / "long.kpc", "--steps", "8") == 0
    assert Groups(tmp_path / "long.kpc").metadata().provenance["options"]["steps"] == 8  # as given, for the first group
    capsys.readouterr()
    assert (
        kpenc.main(
            [
                str(tmp_path / "long.kpc"),
                "-o",
                str(tmp_path / "small.kpc"),
                "--quality",
                "20",
                "--tune-steps",
                "0",
                "--json",
            ]
        )
        == 0
    )
    result, before, after = (
        json.loads(capsys.readouterr().out),
        Groups(tmp_path / "long.kpc"),
        Groups(tmp_path / "small.kpc"),
    )
    assert after.timeline == before.timeline and result["size_bytes"] == (tmp_path / "small.kpc").stat().st_size
    assert all(new < old for new, old in zip(after.size_bytes, before.size_bytes, strict=True))
    assert result["parameters"] == sum(scene_io.read(after.open(number)).parameter_count for number in range(3))


def test_separately_coded_groups_are_joined(videos, tmp_path, capsys):
    parts = [tmp_path / f"part{number}.kpc" for number in range(3)]
    for number, part in enumerate(parts):
        assert encode(videos, part, "--only", str(number), "--keep-checkpoint", str(part.with_suffix(".kpck"))) == 0
        assert Groups(part).timeline.spans == split_into_spans(Clip(FRAMES, 8.0), 1.2)[number : number + 1]
        assert part.with_suffix(".kpck").is_file()
    assert kpjoin.main([*map(str, reversed(parts)), "-o", str(tmp_path / "long.kpc")]) == 0
    joined = Groups(tmp_path / "long.kpc")
    assert joined.timeline.spans == split_into_spans(Clip(FRAMES, 8.0), 1.2) and joined.clip == Clip(FRAMES, 8.0)
    assert all(scene_io.read(joined.open(number)).is_dynamic for number in range(3))


@pytest.mark.parametrize("options, complaint", [
    (["--only", "3"], "has 3 groups"), (["--group", "0.2s"], "too few for a group"),
    (["--keep-checkpoint", "x.kpck"], "single scene"),
])  # fmt: skip
def test_invalid_options_are_refused(videos, tmp_path, capsys, options, complaint):
    try:
        code = encode(videos, tmp_path / "long.kpc", *options)
    except SystemExit as ended:
        code = int(ended.code or 0)
    assert code == 2 and complaint in capsys.readouterr().err and not (tmp_path / "long.kpc").exists()


def test_a_dry_run_counts_all_groups(videos, tmp_path, monkeypatch):
    def first_group(trainer: Trainer, *_: object) -> Estimate:
        return Estimate(10.0, 2.0, 4.0, trainer.dataset.clip.frame_count, 6, 8)

    monkeypatch.setattr(kpenc, "estimate", first_group)
    options = Options(videos, tmp_path / "long.kpc", preset="draft", group_s=1.2, device="cpu")
    later = 2 * LATER_STEPS
    expected = Estimate(10 * (1 + later), 2 * (1 + later), 4 * (1 + later), 8 + OVERLAP, round(6 * (1 + later)), 24)
    assert kpenc.dry_run(options) == expected
    assert kpenc.dry_run(replace(options, test_views=6)) == replace(expected, test_s=6.0, test_pictures=18)
    assert kpenc.dry_run(replace(options, only=1)) == Estimate(10.0, 2.0, 4.0, 9 + 2 * OVERLAP, 6, 8)
    with pytest.raises(UsageError, match="--only 3: the clip has 3 groups"):
        kpenc.dry_run(replace(options, only=3))


@pytest.mark.parametrize(
    "group_s, only, said", [(0.1, None, "--group 0.1s: 0 frames"), (1.2, 3, "--only 3: the clip has 3 groups")]
)
def test_groups_are_refused_before_pictures_are_decoded(videos, tmp_path, monkeypatch, group_s, only, said):
    monkeypatch.setattr(loading, "cached_pixels", lambda *_: pytest.fail("decoded"))
    with pytest.raises(UsageError, match=said):
        kpenc.encode(Options(videos, tmp_path / "long.kpc", group_s=group_s, only=only))
    assert not (tmp_path / "long.kpc.work").exists()


def test_a_group_that_is_longer_than_the_clip_is_logged(capsys):
    options = Options(Path("a"), Path("b"), group_s=10.0)
    assert plan_groups(options, Clip(FRAMES, 8.0)) == (Span(0, FRAMES),)
    assert "the clip lasts 3.25 s, so it is a single group" in capsys.readouterr().err
    assert len(plan_groups(replace(options, group_s=1.2), Clip(FRAMES, 8.0))) == 3 and not capsys.readouterr().err
