"""Stereo 3D-2D resection between two places, across any pairs.

Points that pair a triangulated at the reference are seen by pair b at the current place. Each such (a, b) is treated as
a pair of its own by the search and refinement of section 3.1, see `RigArrays.crossed`. SIFT features are accurate to
about half a pixel; where a pair sees the same points at both places, their patches are then registered to a tenth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.config import Config
from graphvio.frontend.agreement import is_supported
from graphvio.frontend.keyframe_patches import KeyframePatches
from graphvio.frontend.lucas_kanade import MIN_GRADIENT
from graphvio.frontend.observations import Observations, RigArrays, correspond
from graphvio.frontend.prediction import predict_pixels
from graphvio.frontend.refinement import Refined
from graphvio.frontend.selection import joint_motion
from graphvio.frontend.tracks import PairFrame
from graphvio.measurements.sensors import FrameSet
from graphvio.optimization.loops.places import PairObserver
from graphvio.rig import Rig

_FEATURE_SIGMA_PX = 0.7  # of SIFT features instead of tracked corners
_FEATURE_MAX_ERROR_PX = 4.0
_ROUNDS = 2  # of registration, the second predicted from the motion of the first
_MIN_REGISTERED = 30


@dataclass(frozen=True, eq=False)
class Resection:
    """A motion between two places."""

    cur_T_ref: Float  # (4, 4) of body
    covariance: Float  # (6, 6), tangent ``[rotation, translation]`` in body at the current place
    inliers: int  # number of points
    pairs: tuple[tuple[int, int], ...]  # (pair at the reference, pair at the current place) that saw the same points
    is_registered: bool  # whether patches were registered, not only features matched


def resect_features(
    rig: Rig,
    reference: Mapping[int, PairFrame],
    current: Mapping[int, PairFrame],
    matches: Mapping[tuple[int, int], Int],
    config: Config,
    seed: Sequence[int],
) -> Resection | None:
    """Estimate the motion between two places from matched features; None if they do not support one.

    Args:
        rig: of the pairs.
        reference: pair index -> its features with depth at the reference.
        current: pair index -> its features with depth at the current place.
        matches: (a, b) -> matches (M, 2) of a's features at the reference and b's at the current place.
        config: of the motion.
        seed: of RANSAC.
    """
    crossings = sorted(matches)
    observations = _observations(reference, current, [(pair, matches[pair]) for pair in crossings])
    settings = replace(config.motion, pixel_sigma_px=_FEATURE_SIGMA_PX, max_error_px=_FEATURE_MAX_ERROR_PX)
    if len(observations.pair) < settings.min_inliers:
        return None
    arrays = RigArrays.of(rig).crossed(crossings)
    refined = joint_motion(arrays, observations, np.eye(4), settings, np.random.default_rng(list(seed)))
    if not is_supported(refined.inlier, settings):
        return None
    return _resection(refined, crossings, observations.pair, is_registered=False)


def register_patches(
    observers: Sequence[PairObserver], found: Resection, reference: Mapping[int, PairFrame],
    images: tuple[FrameSet, FrameSet], config: Config, seed: Sequence[int],
) -> Resection:  # fmt: skip
    """Refine a motion by registering the patches of pairs that see the same points at both places.

    Returns the given motion if too few patches can be registered. Arguments are those of `resect_features`, and the
    images of the reference and of the current place.
    """
    then, now = images
    pairs = sorted({a for a, b in found.pairs if a == b and a in then.stereo and a in now.stereo})
    if not pairs:
        return found
    rig = RigArrays.of(Rig(tuple(observer.pair for observer in observers)))
    patches = {j: KeyframePatches(observers[j].pair, config.tracking.window_px) for j in pairs}
    known = {j: observers[j].observe(then.stamp_ns, then.stereo[j], reference[j].pixels) for j in pairs}
    for j in pairs:
        patches[j].take(known[j], then.stereo[j][0])
    best = found
    for _ in range(_ROUNDS):
        seen = {j: _registered(observers[j], patches[j], known[j], now, j, best.cur_T_ref) for j in pairs}
        correspondences = correspond(known, seen)
        observations = correspondences.observations
        if len(observations.pair) < _MIN_REGISTERED:
            return best
        refined = joint_motion(rig, observations, best.cur_T_ref, config.motion, np.random.default_rng(list(seed)))
        if refined.inlier.sum() < _MIN_REGISTERED or not is_supported(refined.inlier, config.motion):
            return best
        best = _resection(refined, [(j, j) for j in range(len(observers))], observations.pair, is_registered=True)
    return best


def _registered(
    observer: PairObserver, patches: KeyframePatches, known: PairFrame, now: FrameSet, j: int, cur_T_ref: Float
) -> PairFrame:
    """Register the reference's patches in pair j's images of the current place."""
    camera, images = observer.pair.left, now.stereo[j]
    left_T_left = camera.cam_T_body @ cur_T_ref @ camera.body_T_cam
    depth = np.where(known.has_depth, np.maximum(known.points[:, 2], 0.0), 0.0)
    guess, inverse_depths, valid = predict_pixels(
        known.left, depth, left_T_left, camera.model_number, camera.intrinsics, camera.distortion
    )
    rows = np.flatnonzero(valid & known.has_depth & camera.contains(guess, 8.0))
    pixels, at = patches.find(known.ids[rows], guess[rows], images[0], left_T_left, MIN_GRADIENT)
    rows, pixels, expected = rows[at], pixels[at], inverse_depths[rows][at]
    frame = observer.observe(now.stamp_ns, images, pixels, expected)
    return replace(frame, ids=known.ids[rows])


def _observations(
    reference: Mapping[int, PairFrame],
    current: Mapping[int, PairFrame],
    matches: Sequence[tuple[tuple[int, int], Int]],
) -> Observations:
    """Return matched features with depth at the reference, ordered by the pairs that saw them."""
    parts = []
    for number, ((a, b), rows) in enumerate(matches):
        then, now = reference[a], current[b]
        rows = rows[then.has_depth[rows[:, 0]]]
        one, other = rows[:, 0], rows[:, 1]
        right: Bool = now.has_depth[other]
        parts.append(
            Observations(
                np.full(len(rows), number),
                then.points[one],
                then.covariances[one],
                now.left[other],
                np.where(right[:, None], now.right[other], 0.0),
                right,
            )
        )
    return Observations(*(np.ascontiguousarray(np.concatenate(column)) for column in zip(*parts, strict=True)))


def _resection(refined: Refined, crossings: Sequence[tuple[int, int]], of: Int, is_registered: bool) -> Resection:
    used = np.flatnonzero(np.bincount(of[refined.inlier], minlength=len(crossings)))
    return Resection(
        refined.cur_T_ref,
        refined.covariance,
        int(refined.inlier.sum()),
        tuple(crossings[k] for k in used.tolist()),
        is_registered,
    )
