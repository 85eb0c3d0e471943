"""The recordings of the benchmarks: simulated once and stored, and decoded into memory before times are measured."""

from __future__ import annotations

import argparse
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

import graphvio
from benchmarks.report import log_progress
from graphvio.arrays import Image
from graphvio.errors import GraphvioError
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.rig import Camera, Rig, StereoPair
from graphvio.simulation import SCENE_NAMES, simulate
from graphvio.sources import open_source

SCENES_OF_TWO_PAIRS = tuple(name for name in SCENE_NAMES if name not in ("street", "flight"))


def add_data_option(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--data DIR``, the folder in which simulated recordings are stored."""
    default = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "graphvio" / "benchmarks"
    parser.add_argument(
        "--data",
        type=Path,
        default=default,
        metavar="DIR",
        help="folder that keeps the simulated recordings (default: graphvio/benchmarks in the user's cache)",
    )


def simulated(data: Path, scene: str, duration_s: float | None = None, rig_change: str | None = None) -> Path:
    """Return the folder of a simulated recording, which is rendered if it is missing.

    Args:
        data: folder of all recordings.
        scene: one of `graphvio.simulation.SCENE_NAMES`.
        duration_s: duration of the simulated part of the walk; None for all of it.
        rig_change: one of `graphvio.simulation.RIG_CHANGES`; None if the true cameras do not change.

    Raises:
        GraphvioError: if the recording cannot be written.
    """
    variant = "whole" if duration_s is None else f"{duration_s:g}s"
    if rig_change is not None:
        variant += f"-{rig_change}"

    def render(folder: Path) -> None:
        simulate(scene, folder, duration_s=duration_s, rig_change=rig_change)

    return rendered_once(data, scene, variant, render)


def rendered_once(data: Path, scene: str, variant: str, render: Callable[[Path], object], *sources: Path) -> Path:
    """Return the folder of a recording, which is rendered if it is missing.

    The folder's name ends in a digest of the simulator's sources, so that a recording is rendered again after changes
    of the simulator. Of the modules of scenes, only that of this scene counts.

    Args:
        data: folder of all recordings.
        scene: a scene of the simulator, or one that ``sources`` define.
        variant: text that distinguishes this recording from all others of the scene.
        render: function that writes the recording into a folder that does not exist yet.
        sources: additional source files on which the recording depends.

    Raises:
        GraphvioError: if the recording cannot be written.
    """
    name = f"{scene}-{variant}"
    folder = data / f"{name}-{_digest(scene, sources)}"
    if folder.is_dir():
        return folder
    log_progress(f"rendering {name} into {data}; this is done once and takes about three times its length")
    try:
        data.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{name}-", dir=data) as unfinished:
            made = Path(unfinished) / "recording"
            render(made)
            try:
                made.rename(folder)  # in one step, so that an interrupted render is never taken for a whole one
            except OSError:
                if not folder.is_dir():  # else another run has finished the same recording first
                    raise
    except OSError as error:
        raise GraphvioError(f"{folder}: cannot be written ({error.strerror}); choose another with --data") from None
    return folder


@cache
def _digest(scene: str, sources: tuple[Path, ...]) -> str:
    """Return a digest of all sources that determine a recording's bytes: the simulator, and modules that it imports."""
    package = Path(graphvio.__file__).parent
    taken = ("cameras.py", "geometry.py", "kernels.py", "rig_files/native.py", "sessions/euroc_layout.py")
    scenes = package / "simulation" / "scenes"
    others = {scenes / f"{name}.py" for name in SCENE_NAMES if name != scene}
    others.add(package / "simulation" / "calibration_error.py")  # none of these recordings depends on it
    simulator = sorted(path for path in (package / "simulation").rglob("*.py") if path not in others)
    digest = hashlib.sha256()
    rig = sorted((package / "rig").glob("*.py"))
    for path in [*(package / name for name in taken), *rig, *simulator, *sources]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


@dataclass(frozen=True, eq=False)
class Footage:
    """A recording in memory.

    Attributes:
        rig: rig to which the pair indices refer.
        steps: for each frameset, the measurements since the previous one; the last of them is the frameset.
    """

    rig: Rig
    steps: list[list[Measurement]]

    @staticmethod
    def load(folder: Path, count: int, rig: Rig | None = None) -> Footage:
        """Decode the first framesets of a recording.

        Args:
            folder: folder of the recording.
            count: maximum number of framesets.
            rig: rig with the pairs and IMU to use; None for the recording's own.

        Raises:
            GraphvioError: if the recording cannot be read.
        """
        source = open_source(folder, rig)
        steps: list[list[Measurement]] = []
        waiting: list[Measurement] = []
        for measurement in source:
            waiting.append(measurement)
            if isinstance(measurement, FrameSet):
                steps.append(waiting)
                waiting = []
                if len(steps) == count:
                    break
        return Footage(source.rig, steps)

    @property
    def framesets(self) -> list[FrameSet]:
        """All framesets, in order."""
        return [measurement for step in self.steps for measurement in step if isinstance(measurement, FrameSet)]

    def first(self, count: int) -> Footage:
        """Return only the first framesets."""
        return Footage(self.rig, self.steps[:count])

    def with_pair_count(self, count: int) -> Footage:
        """Return the footage with so many pairs and without the IMU; missing pairs are copies of the recording's."""
        own = len(self.rig.pairs)
        pairs = tuple(_copied(self.rig.pairs[i % own], i // own) for i in range(count))
        framesets = []
        for frameset in self.framesets:
            images = {
                i: (left.copy(), right.copy())
                for i in range(count)
                for left, right in [frameset.images.get(i % own, (None, None))]
                if left is not None and right is not None
            }
            framesets.append(FrameSet(frameset.stamp_ns, images))
        return Footage(Rig(pairs, name=self.rig.name), [[frameset] for frameset in framesets])

    def resized(self, scale: float) -> Footage:
        """Return the footage in another resolution, without the IMU: images are resampled, intrinsics adapted."""
        pairs = tuple(
            replace(pair, left=_resized(pair.left, scale), right=_resized(pair.right, scale)) for pair in self.rig.pairs
        )
        steps: list[list[Measurement]] = []
        for frameset in self.framesets:
            images = {
                j: (_resampled(left, pairs[j].left.size_px), _resampled(right, pairs[j].right.size_px))
                for j, (left, right) in frameset.images.items()
            }
            steps.append([FrameSet(frameset.stamp_ns, images)])
        return Footage(Rig(pairs, name=self.rig.name), steps)


def blocks(measurements: Iterator[Measurement], framesets: int) -> Iterator[list[Measurement]]:
    """Yield measurements in lists of so many framesets each; a list is read completely before it is processed."""
    block: list[Measurement] = []
    held = 0
    for measurement in measurements:
        block.append(measurement)
        held += isinstance(measurement, FrameSet)
        if held == framesets:
            yield block
            block, held = [], 0
    if block:
        yield block


def _copied(pair: StereoPair, copy: int) -> StereoPair:
    if copy == 0:
        return pair
    left = replace(pair.left, name=f"{pair.left.name}-copy{copy}")
    right = replace(pair.right, name=f"{pair.right.name}-copy{copy}")
    return StereoPair(f"{pair.name}-copy{copy}", left, right)


def _resized(camera: Camera, scale: float) -> Camera:
    """Return a camera with ``scale`` times as many pixels a side; pixel (0, 0) is the centre of the upper left one."""
    width, height = (round(scale * size) for size in camera.size_px)
    fx, fy, cx, cy = camera.intrinsics
    intrinsics = np.array([scale * fx, scale * fy, scale * (cx + 0.5) - 0.5, scale * (cy + 0.5) - 0.5])
    return replace(camera, size_px=(width, height), intrinsics=intrinsics, mask=None)


def _resampled(image: Image, size_px: tuple[int, int]) -> Image:
    shrinks = size_px[0] < image.shape[1]
    resampled = cv2.resize(image, size_px, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return np.ascontiguousarray(resampled, dtype=np.uint8)
