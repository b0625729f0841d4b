"""Images and videos are recognised by their suffixes in any case; what systems leave in folders is neither."""

import pytest

from kpc.format.common.media_files import is_hidden, is_image, is_video


@pytest.mark.parametrize("name", ["a.png", "a/b.JPEG", "x.WebP", "x.tif", "x.TIFF", "x.bmp", "x.heic", "x.AVIF"])
def test_images(name: str) -> None:
    assert is_image(name) and not is_video(name) and not is_hidden(name)


@pytest.mark.parametrize("name", ["a.mp4", "cam00.MOV", "x.m4v", "x.MTS", "x.m2ts", "x.ts", "x.webm", "x.mpg", "x.wmv"])
def test_videos(name: str) -> None:
    assert is_video(name) and not is_image(name) and not is_hidden(name)


@pytest.mark.parametrize("name", ["a.txt", "png", ".png", "a.png.part", "GX010001.LRV", "a.npy", "folder"])
def test_neither(name: str) -> None:
    assert not is_image(name) and not is_video(name)


@pytest.mark.parametrize(
    "name", ["images/._0001.png", ".DS_Store", "Thumbs.db", "THUMBS.DB", "desktop.ini", "._cam00.mp4", ".x.mp4.Tr3a"]
)
def test_hidden_and_system_files(name: str) -> None:
    assert is_hidden(name) and not is_image(name) and not is_video(name)
