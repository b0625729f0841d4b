"""The figures of docs/capture.md are those that their script draws."""

from pathlib import Path
from xml.etree import ElementTree

from kpc.tools.dev.capture_figures import FIGURES

DOCS = Path(__file__).parents[2] / "docs"


def test_committed_figures_are_drawn_by_the_script():
    page = (DOCS / "capture.md").read_text()
    for name, draw in FIGURES.items():
        drawn = draw()
        assert drawn == (DOCS / name).read_text(), f"{name}: python -m kpc.tools.dev.capture_figures docs"
        assert f"]({name})" in page
        ElementTree.fromstring(drawn)
