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
from graphvio.results.plotting import plot_evaluation, plot_run
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


def test_plot_run_marks_failures_in_their_colours(tmp_path: Path) -> None:
    trajectory = walk()
    status = [Status.COASTING if 100 <= k < 130 else Status.TRACKING for k in range(300)]
    plot_run(
        tmp_path / "marked.png",
        trajectory.select(np.arange(300) < 300),
        status=status,
        epochs=[int(k >= 200) for k in range(300)],
        lost_ns=[int(trajectory.stamps_ns[199]) + 1],
    )
    plot_run(tmp_path / "clean.png", trajectory, status=[Status.TRACKING] * 300, epochs=[0] * 300)
    for colour in (COASTING_BGR, LOST_BGR, EPOCH_BGR):
        assert has_colour(tmp_path / "marked.png", colour)
        assert not has_colour(tmp_path / "clean.png", colour)


def test_plot_run_with_truth_plots_it_in_nav(tmp_path: Path) -> None:
    truth = walk(bend=0.3).transformed(se3(so3_exp(np.array([0.0, 0.0, 1.0])), np.array([90.0, 0.0, 0.0])))
    evaluation = evaluate(walk(), truth)
    plot_run(tmp_path / "with.png", walk(), truth=truth, evaluation=evaluation, name="walk")
    plot_run(tmp_path / "without.png", walk())
    # The edges of letters are of the same grey as the truth.
    assert pixels_of(tmp_path / "with.png", TRUTH_BGR) > 300 + 2 * pixels_of(tmp_path / "without.png", TRUTH_BGR)
    image = cv2.imread(str(tmp_path / "with.png"))
    assert image is not None
    assert max(image.shape) < 2500  # truth was brought into nav: the plot does not extend over 90 m


@pytest.mark.parametrize(("width_m", "depth_m"), [(200.0, 0.1), (0.1, 200.0), (0.0, 0.0), (1e-3, 1e-3)])
def test_plot_run_of_any_extent_keeps_a_usable_size(tmp_path: Path, width_m: float, depth_m: float) -> None:
    plot_run(tmp_path / "t.png", walk(width_m, depth_m))
    image = cv2.imread(str(tmp_path / "t.png"))
    assert image is not None
    assert 300 < image.shape[0] < 1800
    assert 600 < image.shape[1] < 1800


def test_maps_have_equal_scale_in_every_direction(tmp_path: Path) -> None:
    from graphvio.results.plotting import _maps

    _, plan, side = _maps(walk(30.0, 2.0).positions, None, series=False)
    for axes in (plan, side):
        box = axes.get_window_extent()
        (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
        assert box.width / (x1 - x0) == pytest.approx(box.height / (y1 - y0), rel=1e-6)
    assert plan.get_xlim() == side.get_xlim()


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_plot_evaluation_writes_any_format(tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"e.{ending}"
    plot_evaluation(file, evaluate(walk(bend=0.3), walk()), "walk")
    assert file.stat().st_size > 5000


def test_plot_run_to_unusable_path_or_format_raises(tmp_path: Path) -> None:
    with pytest.raises(GraphvioError, match="cannot be written"):
        plot_run(tmp_path / "no" / "t.png", walk())
    with pytest.raises(GraphvioError, match="end its name in"):
        plot_run(tmp_path / "t.xyz", walk())


def test_plot_run_does_not_import_pyplot(tmp_path: Path) -> None:
    code = """
import sys
from pathlib import Path
import numpy as np
import graphvio.results.plotting as plotting
from graphvio.trajectory import Trajectory
assert "matplotlib" not in sys.modules
plotting.plot_run(Path(sys.argv[1]), Trajectory(np.arange(2), np.array([np.eye(4)] * 2)))
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "t.png")], check=True)
