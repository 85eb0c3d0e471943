"""Where the rig was at a place that it saw before: stereo 3D-2D resection across any pairs.

Points that pair a triangulated at the reference are seen by pair b at the other place. Each such (a, b) is a pair of
its own in the search and refinement of section 3.1, see `RigArrays.crossed`. Features that COLMAP finds lie where they
are to half a pixel or so; where a pair sees again what it saw itself, its patches are then registered to a tenth.
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

_FEATURE_SIGMA_PX = 0.7  # of COLMAP's features in place of tracked corners
_FEATURE_MAX_ERROR_PX = 4.0
_ROUNDS = 2  # of registration: the first one's motion tells the second where to look
_LEAST_REGISTERED = 30


@dataclass(frozen=True, eq=False)
class Resection:
    """A motion between two places.

    Attributes:
        cur_T_ref: (4, 4) of body.
        covariance: (6, 6), tangent ``[rotation, translation]`` in body at the current place.
        inliers: points that it explains.
        pairs: which pair's points which pair saw.
        is_registered: whether it rests on patches, not on features alone.
    """

    cur_T_ref: Float
    covariance: Float
    inliers: int
    pairs: tuple[tuple[int, int], ...]
    is_registered: bool


def resect_features(
    rig: Rig,
    reference: Mapping[int, PairFrame],
    current: Mapping[int, PairFrame],
    matches: Mapping[tuple[int, int], Int],
    config: Config,
    seed: Sequence[int],
) -> Resection | None:
    """The motion that matched features tell, or None where they tell none.

    Args:
        rig: of the pairs.
        reference: pair -> its features with their depth.
        current: the same at the other place.
        matches: (a, b) -> rows (M, 2) of a's features at the reference and b's at the other place.
        config: of the motion.
        seed: of the random triples.
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


def register_again(
    observers: Sequence[PairObserver], found: Resection, reference: Mapping[int, PairFrame],
    images: tuple[FrameSet, FrameSet], config: Config, seed: Sequence[int],
) -> Resection:  # fmt: skip
    """The same motion by the patches of those pairs that see again what they saw themselves; as it was where these
    are few.

    Args:
        observers: of the rig's pairs.
        found: by features.
        reference: pair -> its features with their depth.
        images: of the reference and of the other place.
        config: of the motion.
        seed: of the random triples.
    """
    then, now = images
    pairs = sorted({a for a, b in found.pairs if a == b and a in then.images and a in now.images})
    if not pairs:
        return found
    rig = RigArrays.of(Rig(tuple(observer.pair for observer in observers)))
    patches = {j: KeyframePatches(observers[j].pair, config.tracking.window_px) for j in pairs}
    known = {j: observers[j].observe(then.stamp_ns, then.images[j], reference[j].pixels) for j in pairs}
    for j in pairs:
        patches[j].take(known[j], then.images[j][0])
    best = found
    for _ in range(_ROUNDS):
        seen = {j: _registered(observers[j], patches[j], known[j], now, j, best.cur_T_ref) for j in pairs}
        correspondences = correspond(known, seen)
        observations = correspondences.observations
        if len(observations.pair) < _LEAST_REGISTERED:
            return best
        refined = joint_motion(rig, observations, best.cur_T_ref, config.motion, np.random.default_rng(list(seed)))
        if refined.inlier.sum() < _LEAST_REGISTERED or not is_supported(refined.inlier, config.motion):
            return best
        best = _resection(refined, [(j, j) for j in range(len(observers))], observations.pair, is_registered=True)
    return best


def _registered(
    observer: PairObserver, patches: KeyframePatches, known: PairFrame, now: FrameSet, j: int, cur_T_ref: Float
) -> PairFrame:
    """The reference's patches in pair j's images of the other place."""
    camera, images = observer.pair.left, now.images[j]
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
    """Matched features whose depth is known at the reference, sorted by the crossing that they are from."""
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
