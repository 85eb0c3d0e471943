"""The recordings of the benchmarks: simulated once and kept, and decoded into memory before the clock runs."""

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
    """Add ``--data DIR``, where simulated recordings are kept."""
    default = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "graphvio" / "benchmarks"
    parser.add_argument(
        "--data",
        type=Path,
        default=default,
        metavar="DIR",
        help="folder that keeps the simulated recordings (default: graphvio/benchmarks in the user's cache)",
    )


def simulated(data: Path, scene: str, duration_s: float | None = None, rig_change: str | None = None) -> Path:
    """The folder of a simulated recording, which is made if it is missing.

    Args:
        data: folder of all recordings.
        scene: one of `graphvio.simulation.SCENE_NAMES`.
        duration_s: only so much of the walk; None for all of it.
        rig_change: one of `graphvio.simulation.RIG_CHANGES`; None if the true cameras stay as they are.

    Raises:
        GraphvioError: if it cannot be made.
    """
    variant = "whole" if duration_s is None else f"{duration_s:g}s"
    if rig_change is not None:
        variant += f"-{rig_change}"

    def render(folder: Path) -> None:
        simulate(scene, folder, duration_s=duration_s, rig_change=rig_change)

    return rendered_once(data, scene, variant, render)


def rendered_once(data: Path, scene: str, variant: str, render: Callable[[Path], object], *sources: Path) -> Path:
    """The folder of a recording, which is rendered if it is missing.

    Its name ends in a digest of the simulator's sources, so that a changed simulator renders it again; of the scenes'
    own modules only this scene's counts.

    Args:
        data: folder of all recordings.
        scene: of the simulator's, or one that the sources hold.
        variant: distinguishes this recording from all others of the scene.
        render: writes it into a folder that does not exist yet.
        sources: more files that decide what is rendered.

    Raises:
        GraphvioError: if it cannot be made.
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
    """Digest of all sources that determine the bytes of a recording: the simulator, and the modules that it imports."""
    package = Path(graphvio.__file__).parent
    taken = ("cameras.py", "geometry.py", "kernels.py", "rig_files/native.py", "sessions/euroc_layout.py")
    scenes = package / "simulation" / "scenes"
    others = {scenes / f"{name}.py" for name in SCENE_NAMES if name != scene}
    others.add(package / "simulation" / "calibration_error.py")  # of none of these recordings
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
        rig: to which the pair indices refer.
        steps: for each frameset, the measurements since the one before; the frameset is the last of them.
    """

    rig: Rig
    steps: list[list[Measurement]]

    @staticmethod
    def load(folder: Path, count: int, rig: Rig | None = None) -> Footage:
        """Decode the first framesets of a recording.

        Args:
            folder: of the recording.
            count: framesets at most.
            rig: decides on pairs and IMU; None takes the recording's own.

        Raises:
            GraphvioError: if it cannot be read.
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
        """Only the first framesets."""
        return Footage(self.rig, self.steps[:count])

    def with_pair_count(self, count: int) -> Footage:
        """A rig of so many pairs, without its IMU: beyond the recording's own pairs, copies of them in turn."""
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
        """The same in another resolution, without its IMU: images are resampled, intrinsics follow."""
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
    """Measurements in lists that hold so many framesets each: reading ahead is done before a list is worked on."""
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
    """The camera with ``scale`` times as many pixels a side; pixel (0, 0) is the centre of the upper left one."""
    width, height = (round(scale * size) for size in camera.size_px)
    fx, fy, cx, cy = camera.intrinsics
    intrinsics = np.array([scale * fx, scale * fy, scale * (cx + 0.5) - 0.5, scale * (cy + 0.5) - 0.5])
    return replace(camera, size_px=(width, height), intrinsics=intrinsics, mask=None)


def _resampled(image: Image, size_px: tuple[int, int]) -> Image:
    shrinks = size_px[0] < image.shape[1]
    resampled = cv2.resize(image, size_px, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return np.ascontiguousarray(resampled, dtype=np.uint8)
