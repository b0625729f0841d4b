from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kpc.format.common.images import read_image, write_image
from kpc.tools.cli import contactsheet
from kpc.tools.cli.depth_images import NO_SURFACE


def fill(folder: Path, names: list[str], level: int, size: tuple[int, int] = (40, 60)) -> Path:
    folder.mkdir()
    for name in names:
        write_image(folder / f"{name}.png", np.full((*size, 3), level, np.uint8))
    return folder


def test_truth_rendered_and_depth_stand_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, rendered = (
        fill(tmp_path / "gt", ["a", "b", "c", "d"], 100),
        fill(tmp_path / "out", ["a", "b", "c", "z"], 110),
    )
    for name in "abc":
        depth = np.linspace(1000, 2000, 40 * 60).reshape(40, 60).astype(np.uint16)
        depth[0] = NO_SURFACE
        Image.fromarray(depth).save(rendered / f"{name}_depth.png")
    out = tmp_path / "sheet.png"
    assert contactsheet.main([str(truth), str(rendered), "-o", str(out), "--rows", "2"]) == 0
    printed = capsys.readouterr()
    assert printed.out == f"{out}: mean PSNR 28.13 dB over 3 pictures\n"  # 20 log10(255 / 10)
    assert printed.err == f"contactsheet: {rendered / 'z.png'} and 1 other: no partner of that name, left out\n"
    page, gap, step = read_image(out), contactsheet.GAP, 40 + contactsheet.CAPTION
    assert page.shape == (2 * step + gap, gap + 3 * (60 + gap), 3)
    for row in (gap, gap + step):
        assert (page[row : row + 40, gap : gap + 60] == 100).all()
        assert (page[row : row + 40, 2 * gap + 60 : 2 * gap + 120] == 110).all()
        grey = page[row : row + 40, 3 * gap + 120 : 3 * gap + 180, 0].astype(int)
        assert (grey[0] == 0).all() and (np.diff(grey[1:].ravel()) <= 0).all() and grey[1, 0] > 4 * grey[-1, -1] > 0


def ambiguous(folder: Path) -> Path:
    fill(folder, ["a"], 0)
    write_image(folder / "a.jpg", np.zeros((40, 60, 3), np.uint8))
    return folder


def test_a_sheet_is_not_put_among_the_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, rendered = fill(tmp_path / "gt", ["a"], 0), fill(tmp_path / "out", ["a"], 0)
    for folder in (truth, rendered):
        assert contactsheet.main([str(truth), str(rendered), "-o", str(folder / "sheet.png")]) == 2
        assert f"would lie among the pictures of {folder}" in capsys.readouterr().err
        assert [p.name for p in folder.iterdir()] == ["a.png"]


@pytest.mark.parametrize("name", ["sheet", "sheet.webp", "sheet.gif", "sheet.mp4", "sheet.png/"])
def test_a_sheet_is_a_png_or_jpeg(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    folder = fill(tmp_path / "gt", ["a"], 0)
    with pytest.raises(SystemExit) as error:
        contactsheet.main([str(folder), str(folder), "-o", f"{tmp_path}/{name}"])
    assert error.value.code == 2 and "does not end in .png or .jpg" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["gt"]


@pytest.mark.parametrize(
    "make",
    [
        lambda root: fill(root / "out", ["other"], 0),
        lambda root: fill(root / "out", ["a"], 0, (20, 30)),
        lambda root: root / "out",
        lambda root: ambiguous(root / "out"),
    ],
)
def test_folders_that_do_not_match_are_one_line(make, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, rendered = fill(tmp_path / "gt", ["a"], 0), make(tmp_path)
    assert contactsheet.main([str(truth), str(rendered), "-o", str(tmp_path / "sheet.png")]) in (1, 2)
    error = capsys.readouterr().err
    assert (
        error.startswith(f"contactsheet: {rendered}")
        and error.count("\n") == 1
        and not (tmp_path / "sheet.png").exists()
    )
