"""Plots the diagrams of docs/explanation/how-it-works.md and docs/how-to/live.md.

.venv/bin/python scripts/plot_how_it_works.py
"""

from pathlib import Path
from typing import Any

from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Rectangle

from graphvio.reporting.figures import BLUE as BLUE_LINE
from graphvio.reporting.figures import empty_figure, png

IMAGES = Path(__file__).parent.parent / "docs" / "images"
BLUE, ORANGE, GREEN, PURPLE, GREY = "#dbe7f7", "#fbe3c8", "#dcefd9", "#e9e0f3", "#eeeeee"
DARK = "#333333"
VISION, INERTIAL = BLUE_LINE, "#d98200"


def blank(width_in: float, height_in: float) -> tuple[Any, Any]:
    """Return a figure, and axes in inches without ticks."""
    figure = empty_figure(width_in, height_in, dpi=150)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0.0, width_in)
    axes.set_ylim(0.0, height_in)
    axes.axis("off")
    return figure, axes


def box(axes: Any, place: tuple[float, float, float, float], colour: str, title: str, text: str = "") -> None:
    """Add a box at (left, bottom, width, height) with a title and some lines."""
    left, bottom, width, height = place
    axes.add_patch(FancyBboxPatch((left, bottom), width, height, "round,pad=0,rounding_size=0.08", fc=colour, ec=DARK))
    middle, lines = left + width / 2, text.count("\n") + 1 if text else 0
    top = bottom + height / 2 + 0.095 * lines
    axes.text(middle, top, title, ha="center", va="center", fontsize=10.5, fontweight="bold", color=DARK)
    if text:
        axes.text(middle, top - 0.13, text, ha="center", va="top", fontsize=9, color=DARK, linespacing=1.3)


def arrow(axes: Any, begin: tuple[float, float], end: tuple[float, float], dashed: bool = False) -> None:
    """Add an arrow."""
    line: Any = (0, (4, 3)) if dashed else "solid"
    axes.add_patch(
        FancyArrowPatch(
            begin, end, arrowstyle="-|>", mutation_scale=12, color=DARK, lw=1.2,
            shrinkA=0, shrinkB=0, linestyle=line
        )
    )  # fmt: skip


def stages() -> Any:
    """Plot what happens to a frameset, from the images to the estimate."""
    figure, axes = blank(9.6, 5.3)
    for bottom, name, colour in ((4.1, "front pair", BLUE), (2.8, "back pair", ORANGE)):
        box(axes, (0.1, bottom, 1.25, 0.95), colour, name, "left image\nright image")
        box(axes, (1.7, bottom, 2.05, 0.95), colour, "track", "corners on patches of the\nkeyframe; depth by stereo")
        arrow(axes, (1.35, bottom + 0.47), (1.7, bottom + 0.47))
        arrow(axes, (3.75, bottom + 0.47), (4.1, bottom + 0.47))
    box(
        axes, (4.1, 2.8, 2.2, 2.25), GREEN, "motion",
        "hypotheses of every pair,\neach scored on the points\nof all pairs (eq. 1 to 3);\n"
        "the best is refined on all,\nwith its covariance",
    )  # fmt: skip
    box(axes, (6.9, 4.1, 2.6, 0.95), GREEN, "gate", "is the motion possible,\nby prediction and covariance?")
    box(
        axes, (6.9, 2.3, 2.6, 1.45), GREEN, "window",
        "factor graph of the last 0.75 s:\nmotions, IMU, standstill;\nold states are marginalised",
    )  # fmt: skip
    box(axes, (0.1, 1.1, 1.25, 1.25), GREY, "IMU", "gyro,\naccelerometer")
    box(
        axes, (1.7, 1.1, 2.05, 1.25), GREEN, "predict",
        "by the IMU, or constant\nvelocity without one:\nwhere corners will be",
    )  # fmt: skip
    box(
        axes, (4.1, 0.75, 2.2, 1.6), PURPLE, "self-calibration",
        "adjusts windows of keyframes\nin a thread of its own:\n"
        "intrinsics, stereo extrinsics,\nbody_T_cam of the pairs, IMU",
    )  # fmt: skip
    box(
        axes, (6.9, 0.15, 2.6, 1.7), GREY, "estimate",
        "pose with covariance, velocity,\nbiases, status, events;\nkeyframes for a SLAM system,\n"
        "whose corrections move the map",
    )  # fmt: skip
    arrow(axes, (6.3, 4.57), (6.9, 4.57))
    arrow(axes, (8.2, 4.1), (8.2, 3.75))
    arrow(axes, (8.2, 2.3), (8.2, 1.85))
    arrow(axes, (1.35, 1.72), (1.7, 1.72))
    arrow(axes, (2.72, 2.35), (2.72, 2.8))
    arrow(axes, (4.9, 2.8), (4.9, 2.35), dashed=True)
    arrow(axes, (5.5, 2.35), (5.5, 2.8), dashed=True)
    axes.plot([2.72, 2.72, 6.6, 6.6], [1.1, 0.4, 0.4, 3.02], color=DARK, lw=1.2)  # the prediction is a factor
    arrow(axes, (6.6, 3.02), (6.9, 3.02))
    return figure


def window() -> Any:
    """Plot the factor graph of the smoother."""
    figure, axes = blank(9.6, 3.05)
    xs = [1.6 + 1.25 * number for number in range(6)]
    y = 1.7
    axes.plot([0.55, xs[-1]], [y, y], color=DARK, lw=1.2, zorder=1)
    for number, x in enumerate(xs):
        if number:
            axes.add_patch(
                FancyArrowPatch(
                    (xs[0], y), (x, y), arrowstyle="-", connectionstyle="arc3,rad=-0.32", color=VISION, lw=1.2, zorder=1
                )
            )  # fmt: skip
            square(axes, ((xs[0] + x) / 2, y + 0.16 * (x - xs[0])), VISION)
            square(axes, ((xs[number - 1] + x) / 2, y), INERTIAL)
        axes.plot([x, x], [y, 0.75], color="#999999", lw=0.8, zorder=0)
        circle(axes, (x, y), f"x{number}", BLUE if number else ORANGE)
    square(axes, (0.75, y), DARK)
    axes.plot([xs[0], xs[-1]], [0.75, 0.75], color="#999999", lw=0.8, zorder=0)
    circle(axes, (8.6, 0.75), "g", GREEN)
    axes.plot([xs[-1], 8.6], [0.75, 0.75], color="#999999", lw=0.8, zorder=0)
    for x, colour, text in (
        (0.35, VISION, "motion from the keyframe, by vision"),
        (3.75, INERTIAL, "preintegrated IMU"),
        (5.85, DARK, "prior: what was marginalised"),
    ):
        square(axes, (x, 0.25), colour)
        axes.text(x + 0.17, 0.25, text, va="center", fontsize=10, color=DARK)
    axes.text(xs[0], 1.22, "keyframe", ha="center", fontsize=9.5, color=DARK, bbox={"fc": "white", "ec": "none"})
    axes.text(xs[-1], 2.15, "newest", ha="center", fontsize=9.5, color=DARK)
    axes.text(8.9, 0.75, "gravity", va="center", fontsize=9.5, color=DARK)
    return figure


def threads() -> Any:
    """Plot the threads of the live system and the queues between them."""
    figure, axes = blank(9.6, 2.9)
    box(axes, (0.1, 1.75, 1.15, 0.8), GREY, "source")
    box(axes, (1.65, 1.75, 1.25, 0.8), BLUE, "capture")
    box(axes, (3.85, 1.75, 1.3, 0.8), BLUE, "decode", "pairing")
    box(axes, (5.6, 1.75, 1.8, 0.8), GREEN, "odometry", "front-end, back-end")
    box(axes, (8.3, 1.75, 1.2, 0.8), BLUE, "output")
    box(axes, (8.3, 0.3, 1.2, 0.8), GREY, "viewer")
    box(axes, (3.85, 0.3, 1.3, 0.8), BLUE, "recorder")
    box(axes, (5.6, 0.3, 1.8, 0.8), GREY, "listeners", "gRPC, ROS 2, terminal")
    arrow(axes, (1.25, 2.15), (1.65, 2.15))
    arrow(axes, (2.9, 2.15), (3.85, 2.15))
    arrow(axes, (5.15, 2.15), (5.6, 2.15))
    arrow(axes, (7.4, 2.15), (8.3, 2.15))
    arrow(axes, (8.9, 1.75), (8.9, 1.1))
    arrow(axes, (6.5, 1.75), (6.5, 1.1))
    arrow(axes, (4.5, 1.75), (4.5, 1.1))
    for x, y, text in (
        (3.37, 2.3, "64 images"), (7.85, 2.3, "64 results"), (5.37, 2.68, "8 framesets, all samples"),
        (3.7, 1.42, "120 framesets,\n20 000 messages"),
    ):  # fmt: skip
        axes.text(x, y, text, ha="center", va="center", fontsize=8.5, color=DARK)
    return figure


def circle(axes: Any, place: tuple[float, float], name: str, colour: str) -> None:
    """Add a variable."""
    axes.add_patch(Circle(place, 0.27, fc=colour, ec=DARK, zorder=3))
    axes.text(*place, name, ha="center", va="center", fontsize=10.5, color=DARK, zorder=4)


def square(axes: Any, place: tuple[float, float], colour: str) -> None:
    """Add a factor."""
    axes.add_patch(Rectangle((place[0] - 0.08, place[1] - 0.08), 0.16, 0.16, fc=colour, ec=DARK, lw=0.8, zorder=3))


if __name__ == "__main__":
    (IMAGES / "stages.png").write_bytes(png(stages()))
    (IMAGES / "window.png").write_bytes(png(window()))
    (IMAGES / "threads.png").write_bytes(png(threads()))
