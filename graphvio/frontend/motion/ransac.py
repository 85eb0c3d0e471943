"""Preemptive RANSAC over one or many pairs (section 3.1)."""

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.config.stages import MotionConfig
from graphvio.frontend.motion.cost import MAX_ERROR2, camera_motions, score_all, squared_error_px
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.resection import resect
from graphvio.geometry import se3_compose, se3_inverse
from graphvio.kernels import kernel, put

_MIN_INVERSE_DEPTH = 0.005
_MAX_RELATIVE_DEPTH_SIGMA = 0.3
_FIRST_BATCH = 6


def search(
    rig: RigArrays, observations: Observations, predicted: Float, config: MotionConfig, rng: np.random.Generator
) -> Float:
    """Find the best motion ``cur_T_ref`` (4, 4) among hypotheses of every pair, scored on every pair (section 3.1).

    Hypotheses are sampled in batches until, with probability ``config.confidence``, one of them comes from three
    inliers, given the share of points that the best one explains (M. Fischler, R. Bolles, *Random sample consensus*,
    CACM 24(6), 1981). At most ``config.hypotheses`` triples are sampled of each pair; with confidence 1, all of them at
    once.

    For arguments see `graphvio.frontend.motion.selection.searched_and_refined`.
    """
    best, sampled = predicted, 0
    while sampled < config.hypotheses:
        batch = config.hypotheses if config.confidence >= 1.0 else max(_FIRST_BATCH, sampled)
        batch = min(batch, config.hypotheses - sampled)
        motions, sources = hypothesise(rig, observations, batch, config.pixel_sigma_px, rng)
        best = preempt(
            rig, observations, np.concatenate([best[None], motions]), config.chunk_points, config.cauchy_scale_px, rng
        )
        sampled += batch
        shares = _explained_shares(best, rig, observations, 2.0 * config.cauchy_scale_px)[
            np.flatnonzero(np.bincount(sources))
        ]
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.log1p(-min(config.confidence, 1.0 - 1e-12)) / np.log1p(-(shares**3))
        # A triple of inliers of one pair is enough: an obstructed pair may have none.
        if sampled >= np.min(np.where(shares < 1.0, needed, 0.0), initial=config.hypotheses):
            break
    return best


def hypothesise(
    rig: RigArrays, observations: Observations, count: int, pixel_sigma_px: float, rng: np.random.Generator
) -> tuple[Float, Int]:
    """Generate motion hypotheses by 3-point resection of random triples.

    Args:
        rig: calibration of P pairs.
        observations: points of any subset of them.
        count: number of triples of each pair; some have no solution.
        pixel_sigma_px: standard deviation of a corner's position, by which points of unknown depth are left out.
        rng: source of the random triples.

    Returns:
        ``cur_T_ref`` (H, 4, 4) of body, and the pair (H,) that each is from.
    """
    pairs = np.array(observations.pairs, dtype=np.int64)
    return _resect_triples(pairs, rng.random((len(pairs), count, 3)), rig, observations, pixel_sigma_px)


def preempt(
    rig: RigArrays,
    observations: Observations,
    hypotheses: Float,
    chunk_points: int,
    cauchy_scale_px: float,
    rng: np.random.Generator,
) -> Float:
    """Find the hypothesis (4, 4) that survives when the worse half is dropped after each chunk of points.

    Every hypothesis is scored on a chunk of points of *each* pair, by eq. (3); the scores accumulate. When the points
    are used up, the best score wins.

    Args:
        rig: calibration of P pairs.
        observations: points of any subset of them.
        hypotheses: (H, 4, 4) motions ``cur_T_ref``.
        chunk_points: number of points of each pair in a chunk.
        cauchy_scale_px: scale ``a`` of the robust cost.
        rng: source of the points' order.
    """
    order = rng.permutation(len(observations.pair))
    return _preempt(rig, observations, hypotheses, order, chunk_points, cauchy_scale_px)


@kernel
def _preempt(
    rig: RigArrays, observations: Observations, hypotheses: Float, order: Int, chunk_points: int, cauchy_scale_px: float
) -> Float:
    """Run `preempt` on all points in a random order (N,)."""
    place = _places_in_pair(observations.pair[order], len(rig.body_T_left))
    alive, scores = np.arange(len(hypotheses)), np.zeros(len(hypotheses))
    start = 0
    while len(alive) > 1:
        chunk = order[(place >= start) & (place < start + chunk_points)]
        if len(chunk) == 0:
            break
        of_chunk = score_all(hypotheses[alive], rig, observations, chunk, cauchy_scale_px)
        for i, h in enumerate(alive):
            scores[h] += of_chunk[i]
        ranked = alive[np.argsort(scores[alive], kind="mergesort")]
        alive = ranked[: (len(ranked) + 1) // 2]
        start += chunk_points
    best: Float = hypotheses[alive[np.argmin(scores[alive])]].copy()
    return best


@kernel
def _places_in_pair(pair: Int, pairs: int) -> Int:
    """Count, for each point (N,), how many points of the same pair come before it."""
    before, places = np.zeros(pairs, dtype=np.int64), np.empty(len(pair), dtype=np.int64)
    for i in range(len(pair)):
        places[i] = before[pair[i]]
        before[pair[i]] += 1
    return places


@kernel
def _explained_shares(cur_T_ref: Float, rig: RigArrays, observations: Observations, max_error_px: float) -> Float:
    """Compute the share (P,) of each pair's points that a motion explains in both images; 0 without points."""
    motions = camera_motions(cur_T_ref, rig)
    good, points = np.zeros(len(motions)), np.zeros(len(motions))
    for i in range(len(observations.pair)):
        j = observations.pair[i]
        points[j] += 1.0
        e2 = squared_error_px(motions[j, 0], observations.points[i], observations.left[i], rig.focal_px[j, 0])
        if observations.has_right[i]:
            other = squared_error_px(motions[j, 1], observations.points[i], observations.right[i], rig.focal_px[j, 1])
            e2 = max(e2, other)
        good[j] += 1.0 if e2 < max_error_px * max_error_px else 0.0
    return good / np.maximum(points, 1.0)


@kernel
def _resect_triples(
    pairs: Int, samples: Float, rig: RigArrays, observations: Observations, pixel_sigma_px: float
) -> tuple[Float, Int]:
    """Resect triples of points of some pairs (Q,), which random numbers (Q, H, 3) in [0, 1) select.

    Returns:
        For each triple that has a solution, the motion of body (K, 4, 4) and its pair (K,).
    """
    count = samples.shape[1]
    motions, sources = np.empty((samples.shape[0] * count, 4, 4)), np.empty(samples.shape[0] * count, dtype=np.int64)
    triple, found = np.empty(3, dtype=np.int64), 0
    w, sigma_w = observations.points[:, 2], pixel_sigma_px * np.sqrt(observations.covariances[:, 2, 2])
    usable = (w > _MIN_INVERSE_DEPTH) & (sigma_w < _MAX_RELATIVE_DEPTH_SIGMA * w)
    for q, j in enumerate(pairs):
        rows = np.flatnonzero(usable & (observations.pair == j))
        if len(rows) < 3:
            continue
        left_ref_T_body, body_T_left = se3_inverse(rig.body_T_left[j]), se3_inverse(rig.cam_T_body[j, 0])
        right_T_left = se3_compose(rig.cam_T_body[j, 1], body_T_left)
        for h in range(count):
            for k in range(3):
                triple[k] = rows[int(samples[q, h, k] * len(rows))]
            if triple[0] == triple[1] or triple[0] == triple[2] or triple[1] == triple[2]:
                continue
            left_cur_T_ref, solved = _resect_triple(triple, observations, right_T_left, rig.focal_px[j, 1])
            if solved:
                put(motions[found], se3_compose(se3_compose(body_T_left, left_cur_T_ref), left_ref_T_body))
                sources[found] = j
                found += 1
    return motions[:found], sources[:found]


@kernel
def _resect_triple(triple: Int, observations: Observations, right_T_left: Float, focal_px: float) -> tuple[Float, bool]:
    """Find the motion (4, 4) of the left camera by three points that fits the right image best; False if none."""
    corners, rays = np.empty((3, 3)), np.empty((3, 3))
    points, left, right = observations.points, observations.left, observations.right
    for k in range(3):
        row = triple[k]
        w = points[row, 2]
        corners[k, 0], corners[k, 1], corners[k, 2] = points[row, 0] / w, points[row, 1] / w, 1.0 / w
        x, y = left[row, 0], left[row, 1]
        norm = np.sqrt(x * x + y * y + 1.0)
        rays[k, 0], rays[k, 1], rays[k, 2] = x / norm, y / norm, 1.0 / norm
    poses, count = resect(corners, rays)
    best, least = 0, np.inf
    for c in range(count):
        motion = se3_compose(right_T_left, poses[c])
        error = 0.0
        for k in range(3):
            row = triple[k]
            if observations.has_right[row]:
                error += min(squared_error_px(motion, points[row], right[row], focal_px), MAX_ERROR2)
        if error < least:
            best, least = c, error
    return poses[best], count > 0
