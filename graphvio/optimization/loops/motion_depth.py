"""Depth of single cameras' features from the motion between a place and its neighbours.

Features that match those of a neighbouring place are triangulated with the motion of body in between. The error of that
motion, and with it that of the scale, is common to all features, so that the covariances of single features cannot
express it. Each direction of this error is therefore kept as a shift of all inverse depths together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.frontend.depth.motion_stereo import FirstSights, MotionHistory
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse
from graphvio.optimization.loops.matching import alike
from graphvio.optimization.record import SessionRecord
from graphvio.rig import Camera

FEATURE_SIGMA_PX = 0.7
"""Standard deviation of a SIFT feature's pixel coordinates."""
NEIGHBOURS = (-2, -1, 1, 2)
"""Offsets in a session's list of places: the neighbours with whose features those of a place are matched."""
_MIN_DEPTH_SIGMAS = 3.0  # a more uncertain inverse depth constrains no motion in metres
_MIN_BASELINE_M = 0.02
_DIMENSIONS = 6  # degrees of freedom of a motion
_THEN, _NOW = 0, 1  # stand-ins for the stamps of a neighbour and of the place


@dataclass(frozen=True, eq=False)
class Features:
    """The features of one image."""

    pixels: Float  # (K, 2)
    descriptors: AnyArray  # (K, 128) uint8


@dataclass(frozen=True, eq=False)
class PlaceMotion:
    """Motion of body from one place to a neighbour."""

    place_T_neighbour: Float  # (4, 4)
    covariance: Float  # (6, 6), tangent ``[rotation, translation]`` in body at the neighbour


@dataclass(frozen=True, eq=False)
class Located:
    """Features of one camera at a place with their depths, and the errors that all these depths have in common."""

    # the features as tracks, with covariances due to the noise of the pixels; ``has_depth`` where the inverse depth
    # exceeds three standard deviations
    frame: TrackedFrame
    shifts: Float  # (S, K) shifts of their inverse depths, 1/m, for one standard deviation of each of S errors


def undetermined(camera: Camera, stamp_ns: int, pixels: Float) -> TrackedFrame:
    """Return a frame of features (K, 2) of a single camera, none of which has a depth."""
    n = len(pixels)
    left, _ = camera.unproject(pixels)
    none = np.zeros(n, dtype=np.int64)
    return TrackedFrame(
        stamp_ns, np.arange(n), none, pixels, left, np.zeros((n, 2)), np.zeros((n, 2)),
        np.column_stack([left, np.zeros(n)]), np.zeros((n, 3, 3)), np.zeros((n, 2)), np.zeros(n, dtype=bool), none,
        is_single=True,
    )  # fmt: skip


def located(
    camera: Camera, stamp_ns: int, features: Features, neighbours: Sequence[tuple[Features | None, PlaceMotion]]
) -> Located:
    """Triangulate a single camera's features at a place with its features at neighbouring places, if it has any there.

    Of several neighbours that see a feature, the one with the smallest variance of its inverse depth is used. The error
    of each neighbour's motion gives six shifts.
    """
    frame = undetermined(camera, stamp_ns, features.pixels)
    points, covariances, has_depth = frame.points.copy(), frame.covariances.copy(), frame.has_depth.copy()
    _, has_ray = camera.unproject(features.pixels)
    variances = np.full(len(features.pixels), np.inf)
    shifts = np.zeros((len(neighbours), _DIMENSIONS, len(features.pixels)))
    for number, (other, motion) in enumerate(neighbours):
        camera_motion = camera.cam_T_body @ motion.place_T_neighbour @ camera.body_T_cam
        if other is None or np.linalg.norm(camera_motion[:3, 3]) < _MIN_BASELINE_M:
            continue
        then, seen = camera.unproject(other.pixels)
        rows = alike(features.descriptors, other.descriptors)
        rows = rows[has_ray[rows[:, 0]] & seen[rows[:, 1]]]
        if not len(rows):
            continue
        rays = frame.left_rays[rows[:, 0]], then[rows[:, 1]]
        found, uncertain = _triangulated(camera, *rays, motion.place_T_neighbour)
        shifted = _shifts(camera, *rays, motion, found)
        variance = FEATURE_SIGMA_PX**2 * uncertain[:, 2, 2] + (shifted**2).sum(axis=0)
        better = (found[:, 2] > _MIN_DEPTH_SIGMAS * np.sqrt(variance)) & (variance < variances[rows[:, 0]])
        at: Int = rows[better, 0]
        points[at], covariances[at], variances[at] = found[better], uncertain[better], variance[better]
        has_depth[at] = True
        shifts[:, :, at] = 0.0
        shifts[number][:, at] = shifted[:, better]
    made = replace(frame, points=points, covariances=covariances, has_depth=has_depth)
    return Located(made, shifts.reshape(-1, len(features.pixels)))


def _shifts(camera: Camera, rays: Float, then: Float, motion: PlaceMotion, found: Float) -> Float:
    """Return the shifts (6, M) of inverse depths for one standard deviation along each axis of the motion's error."""
    sizes, axes = np.linalg.eigh(motion.covariance)
    steps = axes * np.sqrt(np.maximum(sizes, 0.0))
    return np.array(
        [
            _triangulated(camera, rays, then, motion.place_T_neighbour @ se3_exp(np.ascontiguousarray(step)))[0][:, 2]
            - found[:, 2]
            for step in steps.T
        ]
    )


def _triangulated(camera: Camera, rays: Float, then: Float, place_T_neighbour: Float) -> tuple[Float, Float]:
    """Triangulate rays (M, 2) at a place with those ``then`` (M, 2) at a neighbour.

    Returns points (M, 3) ``[x, y, 1/Z]`` at the place, and covariances (M, 3, 3).
    """
    sights, history, ids = FirstSights(), MotionHistory(), np.arange(len(rays))
    history.restart(_THEN)
    sights.locate(ids, then, history, camera.body_T_cam, camera.focal_px, FEATURE_SIGMA_PX)
    history.advance(_THEN, _NOW, np.ascontiguousarray(place_T_neighbour), np.zeros((_DIMENSIONS, _DIMENSIONS)))
    return sights.locate(ids, rays, history, camera.body_T_cam, camera.focal_px, FEATURE_SIGMA_PX)


def place_motion(record: SessionRecord, place: int, neighbour: int) -> PlaceMotion | None:
    """Return the motion between two keyframes, given by their rows, or None where the chain between them is broken.

    Errors of the motions from keyframe to keyframe are assumed to be independent.
    """
    first, last = sorted((place, neighbour))
    if record.epoch[first] != record.epoch[last]:
        return None
    covariance, row = np.zeros((6, 6)), last
    while row > first:
        before = int(record.keyframe_before[row])
        if before < first:
            return None
        adjoint = se3_adjoint(np.ascontiguousarray(se3_inverse(record.smoothed[last]) @ record.smoothed[row]))
        covariance += adjoint @ record.keyframe_covariance[row] @ adjoint.T
        row = before
    place_T_neighbour = np.ascontiguousarray(se3_inverse(record.smoothed[place]) @ record.smoothed[neighbour])
    if neighbour == first:  # the covariance is in body at the last of the two
        adjoint = se3_adjoint(se3_inverse(place_T_neighbour))
        covariance = adjoint @ covariance @ adjoint.T
    return PlaceMotion(place_T_neighbour, covariance)
