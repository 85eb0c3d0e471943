"""The README's picture of the corridor and the README's table are of one run."""

import json
import re

from benchmarks.report import DOCS, IMAGES
from benchmarks.walk import ANIMATION_NAME, FIGURES_KEY, PNG_NAME, SCENE
from PIL import Image, ImageSequence

README = (DOCS.parent / "README.md").read_text()


def test_picture_and_table_have_the_same_figures() -> None:
    with Image.open(IMAGES / PNG_NAME) as picture:
        ates_mm = json.loads(picture.info[FIGURES_KEY])
    (row,) = re.findall(rf"^\| simulated {SCENE}, .* \| yes \| (.*) \|$", README, re.MULTILINE)
    shown = [float(cell.split(" mm")[0]) for cell in row.split(" | ")]
    assert shown == list(ates_mm.values()), "scripts/benchmark accuracy --docs writes both"


def test_animation_is_of_the_whole_walk_and_small() -> None:
    with Image.open(IMAGES / ANIMATION_NAME) as animation:
        frames = [frame.convert("L").histogram() for frame in ImageSequence.Iterator(animation)]
    assert len(frames) == 60
    assert frames[0] != frames[30] != frames[59]
    assert (IMAGES / ANIMATION_NAME).stat().st_size < 6e5
    assert f"images/{ANIMATION_NAME}" in README + (DOCS / "index.md").read_text()


def test_each_picture_is_made_by_one_script() -> None:
    """Two that wrote one name put a benchmark's picture where a page explains the stages."""
    texts = {script: script.read_text() for script in (DOCS.parent / "scripts").rglob("*.py")}
    for picture in IMAGES.iterdir():
        makers = [script.name for script, text in texts.items() if picture.name in text]
        assert len(makers) == 1, f"{picture.name}: {makers}"
