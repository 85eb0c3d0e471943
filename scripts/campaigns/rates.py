"""``scripts/campaign rates``: a plot of the angular rates in a turn without vision, like the paper's figure 5.

It shows the bend of the simulated corridor, where both pairs see only blank walls for a second: images of the left
cameras, and below them the angular rates in body by gyro, vision and estimate. The estimate follows vision, then the
gyro, then vision again.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.command_line import Subparsers, add_command
from benchmarks.recordings import add_data_option, simulated
from benchmarks.report import IMAGES, log_progress, writing
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from graphvio.arrays import Float, Image
from graphvio.errors import GraphvioError
from graphvio.measurements.sensors import FrameSet
from graphvio.odometry import Odometry
from graphvio.simulation import build_scene
from graphvio.sources import open_source

_AROUND_S = 1.5
_THUMBNAILS = 8
_COLOURS = {"gyro": "#1f5fbf", "vision": "#d62728", "fused": "#2ca02c"}  # the paper's
_AXES = ("about x (roll)", "about y (pitch)", "about z (yaw)")
_DPI = 130


def add_parser(subparsers: Subparsers) -> None:
    """Add ``rates``."""
    parser = add_command(subparsers, "rates", "a plot of a turn without vision, the paper's figure 5", __doc__, main)
    parser.add_argument("--out", type=Path, metavar="FILE.png", help="write the plot to this file")
    parser.add_argument("--docs", action="store_true", help="write it into docs/images")
    add_data_option(parser)


def main(args: argparse.Namespace) -> None:
    """Run and plot."""
    paths = [path for path in (args.out, IMAGES / "rates.png" if args.docs else None) if path is not None]
    if not paths:
        raise GraphvioError("no output is given: give --out FILE.png or --docs")
    blind_s = build_scene("corridor").events["blank"]
    begin_s, end_s = blind_s[0] - _AROUND_S, blind_s[1] + _AROUND_S
    source = open_source(simulated(args.data, "corridor"), to_s=end_s)
    odometry = Odometry(source.rig)
    rates: dict[str, list[tuple[float, Float]]] = defaultdict(list)
    images: list[tuple[float, list[Image]]] = []
    for measurement in source:
        time_s = (measurement.stamp_ns - source.start_ns) * 1e-9
        if isinstance(measurement, FrameSet) and time_s >= begin_s:
            images.append((time_s, [measurement.images[j][0] for j in sorted(measurement.images)]))
        estimate = odometry.process(measurement)
        if estimate is None:
            continue
        time_s = (estimate.stamp_ns - source.start_ns) * 1e-9
        if time_s >= begin_s:
            for name, rate in estimate.rates.items():
                rates[name].append((time_s, rate))
    odometry.finish()
    names = [pair.name for pair in source.rig.pairs]
    for path in paths:
        _draw(path, names, images, rates, blind_s)
        log_progress(f"written: {path.name}")


def _draw(
    path: Path,
    names: list[str],
    images: list[tuple[float, list[Image]]],
    rates: dict[str, list[tuple[float, Float]]],
    blind_s: tuple[float, float],
) -> None:
    figure = Figure(figsize=(12.0, 9.0), dpi=_DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    halves: Any = figure.subfigures(2, 1, height_ratios=(1.0, 2.6))
    above, below = halves
    chosen = [images[i] for i in np.linspace(0, len(images) - 1, _THUMBNAILS).astype(int)]
    thumbnails = above.subplots(len(names), _THUMBNAILS, squeeze=False)
    for column, (time_s, views) in enumerate(chosen):
        for row, view in enumerate(views):
            axes = thumbnails[row, column]
            axes.imshow(view, cmap="gray", vmin=0, vmax=255)
            axes.set_xticks([])
            axes.set_yticks([])
            if row == 0:
                axes.set_title(f"{time_s:.1f} s", fontsize=9)
            if column == 0:
                axes.set_ylabel(names[row], fontsize=9)
    plots = below.subplots(3, 1, sharex=True)
    for i, axes in enumerate(plots):
        _draw_axis(axes, i, rates, blind_s)
    plots[-1].set_xlabel("seconds")
    below.legend(*plots[0].get_legend_handles_labels(), loc="outside upper center", fontsize=9, ncols=4)
    with writing(path):
        figure.savefig(path)


def _draw_axis(axes: Any, i: int, rates: dict[str, list[tuple[float, Float]]], blind_s: tuple[float, float]) -> None:
    axes.axvspan(*blind_s, color="#eeeeee", label="blank walls in all views")
    for name, colour in _COLOURS.items():
        times = np.array([time_s for time_s, _ in rates[name]])
        values = np.rad2deg([rate[i] for _, rate in rates[name]])
        gaps = np.flatnonzero(np.diff(times) > 0.075) + 1  # no line is plotted across gaps without vision
        axes.plot(
            np.insert(times, gaps, np.nan),
            np.insert(values, gaps, np.nan),
            color=colour,
            linewidth=2.5 if name == "fused" else 1.3,
            alpha=0.5 if name == "fused" else 1.0,
            label=name,
        )
    axes.set_ylabel(f"{_AXES[i]}, deg/s", fontsize=9)
    axes.grid(color="#dddddd", linewidth=0.5)
