"""A plain stereo odometry made of OpenCV functions, as a reference for the speed of the machine.

For each pair, corners are found by ``goodFeaturesToTrack``, matched to the right image and tracked to the next left
image by ``calcOpticalFlowPyrLK``, and triangulated; ``solvePnPRansac`` estimates the motion. Pairs are processed one
after another, and OpenCV uses its own threads.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import cv2
import numpy as np

from graphvio.arrays import Bool, Float, Image
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Camera, Rig, StereoPair

_QUALITY = 0.01
_MAX_ERROR_PX = 3.0
_MIN_DEPTH_M, _MAX_DEPTH_M = 0.3, 100.0
_MIN_POINTS = 6


@dataclass
class _Seen:
    """A pair's last left image, its corners (N, 2) float32 and points (N, 3) in the left camera."""

    left: Image
    corners: Any
    points: Float


@dataclass
class ReferencePipeline:
    """The reference odometry for all pairs of a rig.

    Attributes:
        rig: rig with its calibration.
        corners: maximum number of corners in each left image.
        min_distance_px: minimum distance between two corners.
        tracked: numbers of candidate points of the resection, for each pair and frameset.
        inliers: numbers of inliers among them.
        motions: pair index -> ``left_T_left_prev`` (4, 4) of the newest frameset, where it was found.
    """

    rig: Rig
    corners: int = 300
    min_distance_px: float = 10.0
    tracked: list[int] = field(default_factory=list)
    inliers: list[int] = field(default_factory=list)
    motions: dict[int, Float] = field(default_factory=dict)
    _seen: dict[int, _Seen] = field(default_factory=dict)

    def process(self, frameset: FrameSet) -> dict[str, float]:
        """Estimate the motion of each pair; return stage -> time in milliseconds."""
        stage_ms: dict[str, float] = {}
        self.motions = {}
        for j, (left, right) in sorted(frameset.images.items()):
            last = self._seen.get(j)
            if last is not None:
                self._measure(j, last, left, stage_ms)
            self._seen[j] = self._see(self.rig.pairs[j], left, right, stage_ms)
        return stage_ms

    def _measure(self, j: int, last: _Seen, left: Image, stage_ms: dict[str, float]) -> None:
        with _timed(stage_ms, "calcOpticalFlowPyrLK, previous to now"):
            now, found = _follow(last.left, left, last.corners)
        with _timed(stage_ms, "solvePnPRansac"):
            points = last.points[found]
            self.tracked.append(len(points))
            if len(points) < _MIN_POINTS:
                self.inliers.append(0)
                return
            camera = self.rig.pairs[j].left
            matrix = _matrix(camera)
            pixels = _undistorted(camera, now[found]) * matrix[[0, 1], [0, 1]] + matrix[:2, 2]
            ok, turn, shift, inliers = cv2.solvePnPRansac(points, pixels, matrix, None, reprojectionError=_MAX_ERROR_PX)
            self.inliers.append(len(inliers) if ok and inliers is not None else 0)
            if ok:
                motion = np.eye(4)
                motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
                self.motions[j] = motion

    def _see(self, pair: StereoPair, left: Image, right: Image, stage_ms: dict[str, float]) -> _Seen:
        with _timed(stage_ms, "goodFeaturesToTrack"):
            corners: Any = cv2.goodFeaturesToTrack(left, self.corners, _QUALITY, self.min_distance_px)
        if corners is None:
            return _Seen(left, np.empty((0, 2), dtype=np.float32), np.empty((0, 3)))
        corners = corners.reshape(-1, 2)
        with _timed(stage_ms, "calcOpticalFlowPyrLK, left to right"):
            matched, found = _follow(left, right, corners)
        with _timed(stage_ms, "triangulatePoints"):
            points, good = _triangulated(pair, corners, matched)
        good &= found
        return _Seen(left, corners[good], points[good])


def _follow(first: Image, second: Image, corners: Any) -> tuple[Any, Bool]:
    """Return the corners (N, 2) in a second image, and whether each was found (N,)."""
    if not len(corners):
        return corners, np.zeros(0, dtype=np.bool_)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None)  # type: ignore[call-overload]
    return moved.reshape(-1, 2), np.asarray(status.ravel() > 0)


def _triangulated(pair: StereoPair, left_px: Any, right_px: Any) -> tuple[Float, Bool]:
    """Return points (N, 3) in the left camera, and whether each is in range and near its epipolar line (N,)."""
    left, right = _undistorted(pair.left, left_px), _undistorted(pair.right, right_px)
    right_T_left = pair.right_T_left
    homogeneous = cv2.triangulatePoints(np.eye(3, 4), right_T_left[:3], left.T, right.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = np.ascontiguousarray((homogeneous[:3] / homogeneous[3]).T, dtype=np.float64)
        moved = points @ right_T_left[:3, :3].T + right_T_left[:3, 3]
        error_px = pair.right.focal_px * np.linalg.norm(moved[:, :2] / moved[:, 2:] - right, axis=1)
    depth = points[:, 2]
    return points, np.asarray((error_px < _MAX_ERROR_PX) & (depth > _MIN_DEPTH_M) & (depth < _MAX_DEPTH_M))


def _undistorted(camera: Camera, pixels: Any) -> Float:
    """Return the normalised, undistorted coordinates (N, 2) of pixels (N, 2)."""
    given = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    if camera.model == "equidistant":
        undistorted = cv2.fisheye.undistortPoints(given, _matrix(camera), camera.distortion[:4])
    elif camera.model == "radial-tangential":
        undistorted = cv2.undistortPoints(given, _matrix(camera), camera.distortion[:5])
    else:
        raise ValueError(f"camera {camera.name}: the reference has no {camera.model} lens")
    return np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)


def _matrix(camera: Camera) -> Float:
    fx, fy, cx, cy = camera.intrinsics
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@contextmanager
def _timed(stage_ms: dict[str, float], name: str) -> Iterator[None]:
    start = perf_counter()
    yield
    stage_ms[name] = stage_ms.get(name, 0.0) + 1e3 * (perf_counter() - start)
