"""Plots the README's picture: a walk through the corridor by both pairs and by each alone.

graphvio simulate corridor --duration 32 --out corridor
.venv/bin/python scripts/plot_walk.py corridor [docs/images/walk.png]
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from graphvio import Odometry, Trajectory, load_trajectory, open_source
from graphvio.evaluation import Evaluation, evaluate
from graphvio.reporting.figures import BLUE, RED, add_axes, empty_figure, png
from graphvio.simulation.scenes import build_scene

ROOT = Path(__file__).parent.parent
DURATION_S = 32.0
STRIP = ("people", "door", "blank")
TITLES = {"door": "a door swings open", "people": "a crowd", "blank": "blank walls"}
RUNS = (("front pair alone", (0,), RED), ("back pair alone", (1,), "#d98200"), ("both pairs", (0, 1), BLUE))


def evaluated(recording: Path, pairs: tuple[int, ...]) -> Evaluation:
    """Run the odometry with some of the pairs and the IMU, and compare with the truth."""
    source = open_source(recording)
    odometry = Odometry(source.rig.with_pairs(pairs))
    estimates = [odometry.process(measurement) for measurement in open_source(recording, odometry.rig)]
    posed = [e for e in (*estimates, *odometry.finish()) if e is not None and e.nav_T_body is not None]
    assert source.truth is not None
    stamps_ns = np.array([e.stamp_ns for e in posed], dtype=np.int64)
    return evaluate(Trajectory(stamps_ns, np.array([e.nav_T_body for e in posed])), load_trajectory(source.truth))


def main() -> None:
    recording = Path(sys.argv[1])
    out = Path(sys.argv[2]) if len(sys.argv) > 2 else ROOT / "docs/images/walk.png"
    moments = build_scene("corridor", DURATION_S).events
    figure = empty_figure(9.6, 5.6, dpi=130)
    files = [sorted((recording / f"mav0/cam{camera}/data").glob("*.png")) for camera in (0, 2)]
    begin_ns = int(files[0][0].stem)
    names = sorted(TITLES, key=lambda name: moments[name][0])
    for column, name in enumerate(names):
        at_ns = begin_ns + int(0.5e9 * sum(moments[name]))
        for row, (camera, title) in enumerate(zip(files, ("front", "back"), strict=True)):
            axes = figure.add_axes((0.075 + 0.31 * column, 0.695 - 0.255 * row, 0.295, 0.25))
            image = cv2.imread(str(min(camera, key=lambda file: abs(int(file.stem) - at_ns))), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            axes.imshow(image[60:420], cmap="gray", vmin=0, vmax=255, aspect="auto")
            axes.set_xticks([])
            axes.set_yticks([])
            if row == 0:
                axes.set_title(TITLES[name], fontsize=10)
            if column == 0:
                axes.set_ylabel(title, fontsize=10)
    axes = add_axes(figure, (0.075, 0.09, 0.915, 0.315))
    for name, pairs, colour in RUNS:
        found = evaluated(recording, pairs)
        label = f"{name}: ATE {100 * found.ate_position_m.rmse:.1f} cm"
        times = (found.stamps_ns - begin_ns) * 1e-9
        axes.plot(times, 100 * found.position_error_m, color=colour, lw=1.8 if len(pairs) > 1 else 1.1, label=label)
    for name in names:
        axes.axvspan(*moments[name], color="#eeeeee", zorder=0)
        axes.text(
            0.5 * sum(moments[name]), axes.get_ylim()[1] * 0.93, TITLES[name], ha="center", va="top", fontsize=8.5
        )
    axes.set_xlim(0.0, DURATION_S)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time, s")
    axes.set_ylabel("position error, cm")
    axes.legend(loc="center", fontsize=9)
    out.write_bytes(png(figure))


if __name__ == "__main__":
    main()
