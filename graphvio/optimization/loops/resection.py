"""3D-2D resection between two places, across any pairs and single cameras.

Pair a at the reference gives points, by stereo or, if it is a single camera, by the motion to neighbouring places; pair
b at the current place sees them. Each such (a, b) is treated as a pair of its own by the search and refinement of
section 3.1, see `RigArrays.crossed`. SIFT features are accurate to about half a pixel; where a pair sees the same
points at both places, their patches are then registered to a tenth of a pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.config import Config
from graphvio.config.stages import MotionConfig
from graphvio.frontend.depth.prediction import predict_pixels
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.imaging.lucas_kanade import MIN_GRADIENT
from graphvio.frontend.motion.observations import Observations, RigArrays, correspond
from graphvio.frontend.motion.refinement import Refined, refine
from graphvio.frontend.motion.selection import searched_and_refined
from graphvio.frontend.pairs.agreement import is_supported
from graphvio.frontend.tracking.keyframe_patches import KeyframePatches
from graphvio.geometry import se3_inverse, se3_log
from graphvio.measurements.sensors import FrameSet
from graphvio.optimization.loops.motion_depth import FEATURE_SIGMA_PX
from graphvio.optimization.loops.places import PairObserver
from graphvio.rig import Rig

_FEATURE_MAX_ERROR_PX = 4.0
_ROUNDS = 2  # of registration; the second is predicted with the motion that the first found
_MIN_REGISTERED = 30


@dataclass(frozen=True, eq=False)
class Resection:
    """A motion between two places."""

    cur_T_ref: Float  # (4, 4) motion of body
    covariance: Float  # (6, 6), tangent ``[rotation, translation]`` in body at the current place
    inliers: int  # number of inlier points
    pairs: tuple[tuple[int, int], ...]  # (pair at the reference, pair at the current place) that saw the same points
    is_registered: bool  # whether patches were registered, not only features matched
    # (6, 6), same tangent, due to errors that all points have in common; it is not included in ``covariance``
    shared_covariance: Float = field(default_factory=lambda: np.zeros((6, 6)))


def resect_features(
    rig: Rig,
    reference: Mapping[int, TrackedFrame],
    current: Mapping[int, TrackedFrame],
    matches: Mapping[tuple[int, int], Int],
    config: Config,
    seed: Sequence[int],
    shifts: Mapping[int, Float] | None = None,
) -> Resection | None:
    """Estimate the motion between two places from matched features; None if they do not support one.

    Args:
        rig: the rig with the pairs and single cameras.
        reference: pair index -> its features with depth at the reference.
        current: pair index -> its features with depth at the current place.
        matches: (a, b) -> matches (M, 2) of a's features at the reference and b's at the current place.
        config: the configuration of the motion estimate.
        seed: the seed of RANSAC.
        shifts: single camera's index -> shifts (S, K) of its features' inverse depths at the reference, for one
            standard deviation of each of S errors that all features have in common; None without single cameras.
    """
    crossings = sorted(matches)
    observations = _observations(reference, current, [(pair, matches[pair]) for pair in crossings])
    settings = replace(config.motion, pixel_sigma_px=FEATURE_SIGMA_PX, max_error_px=_FEATURE_MAX_ERROR_PX)
    if len(observations.pair) < settings.min_inliers:
        return None
    arrays = RigArrays.of(rig).crossed(crossings)
    refined = searched_and_refined(arrays, observations, np.eye(4), settings, np.random.default_rng(list(seed)))
    if not is_supported(refined.inlier, settings):
        return None
    found = _resection(refined, crossings, observations.pair, is_registered=False)
    if not shifts:
        return found
    kept = observations.of_rows(refined.inlier)
    parts = [_shifts_of(reference[a], matches[a, b], shifts.get(a)) for a, b in crossings]
    count = max(len(part) for part in parts)
    of_kept = np.concatenate([part if len(part) else np.zeros((count, part.shape[1])) for part in parts], axis=1)
    shared = _shared_covariance(arrays, kept, of_kept[:, refined.inlier], refined.cur_T_ref, settings)
    return replace(found, shared_covariance=shared)


def _shifts_of(reference: TrackedFrame, rows: Int, shifts: Float | None) -> Float:
    """Return the shifts (S, M) of the matched features that have a depth; (0, M) for features of a stereo pair."""
    rows = rows[reference.has_depth[rows[:, 0]], 0]
    return np.zeros((0, len(rows))) if shifts is None else np.asarray(shifts[:, rows])


def _shared_covariance(
    rig: RigArrays, observations: Observations, shifts: Float, cur_T_ref: Float, settings: MotionConfig
) -> Float:
    """Return the covariance (6, 6), in body at the current place, due to errors that shift the depths of all points.

    Args:
        rig: the arrays of the rig for the crossings.
        observations: N inliers.
        shifts: shifts (S, N) of their inverse depths.
        cur_T_ref: the motion (4, 4) without shifts.
        settings: the configuration of the motion estimate.
    """
    covariance = np.zeros((6, 6))
    for shift in shifts:
        if not shift.any():
            continue
        points = observations.points.copy()
        points[:, 2] += shift
        moved = refine(rig, observations._replace(points=points), cur_T_ref, settings)
        error = se3_log(np.ascontiguousarray(moved.cur_T_ref @ se3_inverse(cur_T_ref)))
        covariance += np.outer(error, error)
    return covariance


def register_patches(
    observers: Sequence[PairObserver], found: Resection, reference: Mapping[int, TrackedFrame],
    images: tuple[FrameSet, FrameSet], config: Config, seed: Sequence[int],
) -> Resection:  # fmt: skip
    """Refine a motion by registering the patches of pairs that see the same points at both places.

    Returns the given motion if too few patches can be registered. Arguments are those of `resect_features`, the motion
    to refine, and the images of the reference and of the current place.
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
        refined = searched_and_refined(
            rig, observations, best.cur_T_ref, config.motion, np.random.default_rng(list(seed))
        )
        if refined.inlier.sum() < _MIN_REGISTERED or not is_supported(refined.inlier, config.motion):
            return best
        best = _resection(refined, [(j, j) for j in range(len(observers))], observations.pair, is_registered=True)
    return best


def _registered(
    observer: PairObserver, patches: KeyframePatches, known: TrackedFrame, now: FrameSet, j: int, cur_T_ref: Float
) -> TrackedFrame:
    """Register the reference's patches in pair j's images of the current place."""
    camera, images = observer.pair.left, now.stereo[j]
    left_T_left = camera.cam_T_body @ cur_T_ref @ camera.body_T_cam
    depth = np.where(known.has_depth, np.maximum(known.points[:, 2], 0.0), 0.0)
    guess, inverse_depths, valid = predict_pixels(
        known.left_rays, depth, left_T_left, camera.model_number, camera.intrinsics, camera.distortion
    )
    rows = np.flatnonzero(valid & known.has_depth & camera.contains(guess, 8.0))
    pixels, at = patches.find(known.ids[rows], guess[rows], images[0], left_T_left, MIN_GRADIENT)
    rows, pixels, expected = rows[at], pixels[at], inverse_depths[rows][at]
    frame = observer.observe(now.stamp_ns, images, pixels, expected)
    return replace(frame, ids=known.ids[rows])


def _observations(
    reference: Mapping[int, TrackedFrame],
    current: Mapping[int, TrackedFrame],
    matches: Sequence[tuple[tuple[int, int], Int]],
) -> Observations:
    """Return the matches whose feature has a depth at the reference as observations, ordered by crossing."""
    parts = []
    for number, ((a, b), rows) in enumerate(matches):
        then, now = reference[a], current[b]
        rows = rows[then.has_depth[rows[:, 0]]]
        one, other = rows[:, 0], rows[:, 1]
        right: Bool = now.has_right[other]
        parts.append(
            Observations(
                np.full(len(rows), number),
                then.points[one],
                then.covariances[one],
                now.left_rays[other],
                np.where(right[:, None], now.right_rays[other], 0.0),
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
