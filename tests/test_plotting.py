import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from graphvio.errors import GraphvioError
from graphvio.evaluation import evaluate
from graphvio.geometry import se3, so3_exp
from graphvio.measurements.estimate import Status
from graphvio.results.plotting import draw_evaluation, draw_run
from graphvio.trajectory import Trajectory

COASTING_BGR, LOST_BGR, EPOCH_BGR, TRUTH_BGR = (28, 142, 242), (40, 39, 214), (173, 68, 142), (85, 85, 85)


def walk(width_m: float = 8.0, depth_m: float = 4.0, bend: float = 0.0) -> Trajectory:
    u = np.linspace(0.0, 6.0, 300)
    positions = np.column_stack([width_m * np.sin(u), depth_m * np.cos(u) + bend * u, 0.3 * np.sin(2 * u)])
    poses = np.array([se3(so3_exp(np.array([0.0, 0.0, a])), p) for a, p in zip(u, positions, strict=True)])
    return Trajectory(np.arange(300) * 50_000_000, poses)


def has_colour(picture: Path, bgr: tuple[int, int, int]) -> bool:
    """Whether the plot, without its legend, has some pixels of a colour."""
    return pixels_of(picture, bgr) > 20


def pixels_of(picture: Path, bgr: tuple[int, int, int]) -> int:
    image = cv2.imread(str(picture))
    assert image is not None
    off = np.abs(image[140:].astype(int) - bgr).max(axis=2)
    return int((off < 12).sum())


def test_failures_are_marked_in_their_colours(tmp_path: Path) -> None:
    trajectory = walk()
    status = [Status.COASTING if 100 <= k < 130 else Status.TRACKING for k in range(300)]
    draw_run(
        tmp_path / "marked.png",
        trajectory.select(np.arange(300) < 300),
        status=status,
        epochs=[int(k >= 200) for k in range(300)],
        lost_ns=[int(trajectory.stamps_ns[199]) + 1],
    )
    draw_run(tmp_path / "clean.png", trajectory, status=[Status.TRACKING] * 300, epochs=[0] * 300)
    for colour in (COASTING_BGR, LOST_BGR, EPOCH_BGR):
        assert has_colour(tmp_path / "marked.png", colour)
        assert not has_colour(tmp_path / "clean.png", colour)


def test_truth_is_drawn_when_known(tmp_path: Path) -> None:
    truth = walk(bend=0.3).transformed(se3(so3_exp(np.array([0.0, 0.0, 1.0])), np.array([90.0, 0.0, 0.0])))
    evaluation = evaluate(walk(), truth)
    draw_run(tmp_path / "with.png", walk(), truth=truth, evaluation=evaluation, name="walk")
    draw_run(tmp_path / "without.png", walk())
    # The edges of letters have truth's grey, too.
    assert pixels_of(tmp_path / "with.png", TRUTH_BGR) > 300 + 2 * pixels_of(tmp_path / "without.png", TRUTH_BGR)
    image = cv2.imread(str(tmp_path / "with.png"))
    assert image is not None
    assert max(image.shape) < 2500  # truth was brought into nav: the picture does not interval 90 m


@pytest.mark.parametrize(("width_m", "depth_m"), [(200.0, 0.1), (0.1, 200.0), (0.0, 0.0), (1e-3, 1e-3)])
def test_any_extent_can_be_drawn(tmp_path: Path, width_m: float, depth_m: float) -> None:
    draw_run(tmp_path / "t.png", walk(width_m, depth_m))
    image = cv2.imread(str(tmp_path / "t.png"))
    assert image is not None
    assert 300 < image.shape[0] < 1800
    assert 600 < image.shape[1] < 1800


def test_one_metre_is_as_long_in_every_direction(tmp_path: Path) -> None:
    from graphvio.results.plotting import _maps

    _, plan, side = _maps(walk(30.0, 2.0).positions, None, series=False)
    for axes in (plan, side):
        box = axes.get_window_extent()
        (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
        assert box.width / (x1 - x0) == pytest.approx(box.height / (y1 - y0), rel=1e-6)
    assert plan.get_xlim() == side.get_xlim()


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_evaluation_is_drawn_in_any_format(tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"e.{ending}"
    draw_evaluation(file, evaluate(walk(bend=0.3), walk()), "walk")
    assert file.stat().st_size > 5000


def test_places_and_formats_that_do_not_work(tmp_path: Path) -> None:
    with pytest.raises(GraphvioError, match="cannot be written"):
        draw_run(tmp_path / "no" / "t.png", walk())
    with pytest.raises(GraphvioError, match="end its name in"):
        draw_run(tmp_path / "t.xyz", walk())


def test_pyplot_is_left_alone() -> None:
    code = "import graphvio.results.plotting, sys; assert 'matplotlib.pyplot' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
