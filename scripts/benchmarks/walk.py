"""``scripts/benchmark walk``: the README's picture and animation of the corridor, with all pairs and with each alone.

All runs use the IMU. ``scripts/benchmark accuracy --docs`` also writes picture and animation, from the runs of its
tables. The PNG file contains its figures as text, which a test compares with the README's table, so that both are of
the same run.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from PIL import Image as Picture

from benchmarks.bench import Bench
from benchmarks.command_line import Subparsers, add_command
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import IMAGES, log_progress, writing
from benchmarks.runs import Outcome
from graphvio.arrays import Float, Image
from graphvio.config import Config
from graphvio.reporting.figures import BLUE, RED, add_axes, empty_figure
from graphvio.simulation.scenes import build_scene

SCENE, PROFILE = "corridor", "default"
PNG_NAME, ANIMATION_NAME = "walk.png", "walk.webp"
FIGURES_KEY = "figures"
"""Key of the text in the PNG file that has the ATE of each run in millimetres, as JSON."""
_TITLES = {"door": "a door swings open", "people": "a crowd", "blank": "a blank bend", "dim": "the lamps fail"}
_SIDES = (("front", 0), ("back", 2))
_COLOURS = (BLUE, RED, "#d98200")  # all pairs together first
_ROWS = slice(60, 420)
_STEP_S, _FRAME_MS, _PAUSE_MS = 1.0, 200, 3000
_QUALITY = 40


def add_parser(subparsers: Subparsers) -> None:
    """Add the subcommand."""
    parser = add_command(subparsers, "walk", "the README's picture and animation of the corridor", __doc__, _run)
    out = Path("results") / "benchmarks"
    parser.add_argument("--out", type=Path, default=out, metavar="DIR", help=f"default: {out}")
    parser.add_argument("--docs", action="store_true", help="write them into docs/images")
    add_data_option(parser)


def _run(args: argparse.Namespace) -> None:
    bench = Bench({SCENE: simulated(args.data, SCENE)}, {PROFILE: Config.load(PROFILE)})
    draw_walk(bench, IMAGES if args.docs else args.out)


def draw_walk(bench: Bench, folder: Path) -> None:
    """Write the picture and the animation of the whole corridor into a folder.

    Raises:
        GraphvioError: if the walk cannot be run, or the files cannot be written.
    """
    walk = _Walk.of(bench)
    with writing(folder / PNG_NAME):
        text = json.dumps({name: round(1e3 * outcome.ate_m, 1) for name, outcome in walk.runs.items()})
        walk.picture().savefig(folder / PNG_NAME, metadata={"Software": None, FIGURES_KEY: text})
        walk.save_animation(folder / ANIMATION_NAME)
    log_progress(f"{folder / PNG_NAME}, {folder / ANIMATION_NAME}: {text}")


@dataclass(frozen=True, eq=False)
class _Walk:
    """The runs over the corridor and its images.

    Attributes:
        runs: name of the pairs -> run, all pairs first.
        files: image files of the left camera of each pair, in the order of their stamps.
        moments: name of a hard moment -> its start and end, seconds.
        duration_s: duration of the recording.
    """

    runs: dict[str, Outcome]
    files: dict[str, list[Path]]
    moments: dict[str, tuple[float, float]]
    duration_s: float

    @staticmethod
    def of(bench: Bench) -> _Walk:
        recording = bench.recordings[SCENE]
        together, *alone = bench.choices(SCENE)
        choices = {"both pairs": together, **{f"{bench.pair_names(SCENE, p)} pair alone": p for p in alone}}
        files = {side: sorted((recording / f"mav0/cam{cam}/data").glob("*.png")) for side, cam in _SIDES}
        stems = [int(file.stem) for file in files["front"]]
        duration_s = (stems[-1] - stems[0]) * 1e-9
        moments = build_scene(SCENE, duration_s).events
        runs = {name: bench.outcome(SCENE, PROFILE, pairs, True) for name, pairs in choices.items()}
        return _Walk(runs, files, {name: moments[name] for name in _TITLES}, duration_s)

    @property
    def begin_ns(self) -> int:
        return int(self.files["front"][0].stem)

    def image(self, side: str, time_s: float) -> Image:
        """Return the image nearest to a time, cropped to a wide format."""
        at_ns = self.begin_ns + round(1e9 * time_s)
        file = min(self.files[side], key=lambda each: abs(int(each.stem) - at_ns))
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None, file
        return np.ascontiguousarray(image[_ROWS], dtype=np.uint8)

    def errors_cm(self, outcome: Outcome) -> tuple[Float, Float]:
        """Return times in seconds, and the position errors after alignment of the whole run, centimetres."""
        assert outcome.evaluation is not None  # the benchmark's own recordings can be evaluated
        times_s = np.asarray(1e-9 * (outcome.evaluation.stamps_ns - self.begin_ns), dtype=np.float64)
        return times_s, 100 * outcome.evaluation.position_error_m

    def picture(self) -> Figure:
        """Return the figure: images of both pairs at the hard moments, and the errors over time below them."""
        figure = empty_figure(9.6, 5.0, dpi=130)
        for column, (name, (begin_s, end_s)) in enumerate(self.moments.items()):
            for row, (side, _) in enumerate(_SIDES):
                axes = figure.add_axes((0.075 + 0.231 * column, 0.725 - 0.232 * row, 0.222, 0.222))
                _show(axes, self.image(side, 0.5 * (begin_s + end_s)))
                if row == 0:
                    axes.set_title(_TITLES[name], fontsize=10)
                if column == 0:
                    axes.set_ylabel(side, fontsize=10)
        self._error_axes(figure, (0.075, 0.1, 0.915, 0.36))
        return figure

    def _error_axes(self, figure: Figure, place: tuple[float, float, float, float]) -> list[Any]:
        """Add axes with the errors over time; return the lines, in the order of the runs."""
        axes = add_axes(figure, place)
        lines: list[Any] = []
        highest = max(float(self.errors_cm(outcome)[1].max()) for outcome in self.runs.values())
        for (name, outcome), colour in zip(self.runs.items(), _COLOURS, strict=True):
            width = 1.8 if name == "both pairs" else 1.1
            label = f"{name}: ATE {1e3 * outcome.ate_m:.1f} mm"
            lines += axes.plot(*self.errors_cm(outcome), color=colour, lw=width, zorder=9 - len(lines), label=label)
        for name, (begin_s, end_s) in self.moments.items():
            axes.axvspan(begin_s, end_s, color="#eeeeee", zorder=0)
            at = (0.5 * (begin_s + end_s), 1.15 * highest)
            axes.text(*at, _TITLES[name], ha="center", va="top", fontsize=8)
        axes.set_xlim(0.0, self.duration_s)
        axes.set_ylim(0.0, 1.2 * highest)
        axes.set_xlabel("time, s")
        axes.set_ylabel("position error, cm")
        axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.9), fontsize=8.5)
        return lines

    def save_animation(self, path: Path) -> None:
        """Write an animation at five times the speed: the pairs' images, the rig's position, and the errors so far."""
        figure = empty_figure(7.2, 4.2, dpi=100)
        views = [figure.add_axes((0.01 + 0.325 * i, 0.535, 0.32, 0.427)) for i in range(2)]
        shown = [_show(axes, self.image(side, 0.0)) for axes, (side, _) in zip(views, _SIDES, strict=True)]
        for axes, (side, _) in zip(views, _SIDES, strict=True):
            axes.set_title(side, fontsize=9, pad=3)
        together = next(iter(self.runs.values()))
        plan = figure.add_axes((0.67, 0.535, 0.32, 0.427))
        plan.set_title("from above", fontsize=9, pad=3)
        plan.plot(*together.truth.positions[:, :2].T, color="#cccccc", lw=3)
        plan.set_aspect("equal", adjustable="datalim")
        plan.set_xticks([])
        plan.set_yticks([])
        (path_line,) = plan.plot([], [], color=_COLOURS[0], lw=1.5)
        (place,) = plan.plot([], [], "o", color=_COLOURS[0], ms=5)
        lines = self._error_axes(figure, (0.085, 0.115, 0.9, 0.36))
        pictures = []
        assert together.evaluation is not None
        walked = together.evaluation.aligned
        for time_s in np.arange(0.0, self.duration_s + 1e-9, _STEP_S):
            for artist, (side, _) in zip(shown, _SIDES, strict=True):
                artist.set_data(self.image(side, time_s))
            positions = walked.positions[walked.stamps_ns <= self.begin_ns + round(1e9 * time_s)]
            path_line.set_data(*positions[:, :2].T)
            place.set_data(*positions[-1:, :2].T)
            for line, outcome in zip(lines, self.runs.values(), strict=True):
                times_s, errors_cm = self.errors_cm(outcome)
                line.set_data(times_s[times_s <= time_s], errors_cm[times_s <= time_s])
            buffer = BytesIO()
            figure.savefig(buffer, format="png")
            pictures.append(Picture.open(buffer).convert("RGB"))
        durations = [_FRAME_MS] * (len(pictures) - 1) + [_PAUSE_MS]
        first, *others = pictures
        first.save(path, save_all=True, append_images=others, duration=durations, loop=0, quality=_QUALITY, method=4)


def _show(axes: Any, image: Image) -> Any:
    axes.set_xticks([])
    axes.set_yticks([])
    return axes.imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto")
