"""Preemptive RANSAC over one or many pairs (section 3.1)."""

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.config import MotionConfig
from graphvio.frontend.cost import WORST, left_motions, score_all, squared_error_px
from graphvio.frontend.observations import Observations, RigArrays
from graphvio.frontend.resection import resect
from graphvio.geometry import se3_inverse
from graphvio.kernels import kernel

_MIN_INVERSE_DEPTH = 0.005
_MAX_RELATIVE_DEPTH_SIGMA = 0.3
_FIRST_BATCH = 12


def search(
    rig: RigArrays, observations: Observations, predicted: Float, config: MotionConfig, rng: np.random.Generator
) -> Float:
    """The best motion ``cur_T_ref`` (4, 4): hypotheses of every pair, scored on every pair (section 3.1).

    Hypotheses are drawn in batches, until one of them rests with probability ``config.confidence`` on three right
    points, as far as the share that the best one explains tells (M. Fischler, R. Bolles, *Random sample consensus*,
    CACM 24(6), 1981); ``config.hypotheses`` of each pair is the most, and confidence 1 draws them all at once.

    For arguments see `graphvio.frontend.selection.joint_motion`.
    """
    best, drawn = predicted, 0
    pairs = [int(pair) for pair in np.unique(observations.pair)]
    while drawn < config.hypotheses:
        batch = config.hypotheses if config.confidence >= 1.0 else max(_FIRST_BATCH, drawn)
        batch = min(batch, config.hypotheses - drawn)
        found = [hypothesise(rig, observations, pair, batch, config.pixel_sigma_px, rng) for pair in pairs]
        best = preempt(
            rig, observations, np.concatenate([best[None], *found]), config.chunk_points, config.cauchy_scale_px, rng
        )
        drawn += batch
        shares = _explained_shares(best, rig, observations, 2.0 * config.cauchy_scale_px)
        shares = shares[[pair for pair, motions in zip(pairs, found, strict=True) if len(motions)]]
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.log1p(-min(config.confidence, 1.0 - 1e-12)) / np.log1p(-(shares**3))
        # One pair's right triple is enough: a pair that something stands in front of may have none.
        if drawn >= np.min(np.where(shares < 1.0, needed, 0.0), initial=config.hypotheses):
            break
    return best


def hypothesise(
    rig: RigArrays,
    observations: Observations,
    pair: int,
    count: int,
    pixel_sigma_px: float,
    rng: np.random.Generator,
) -> Float:
    """Motions ``cur_T_ref`` (H, 4, 4) of body, by 3-point resection of one pair's random triples, H <= count."""
    sigma_w = pixel_sigma_px * np.sqrt(observations.covariances[:, 2, 2])
    w = observations.points[:, 2]
    usable = (observations.pair == pair) & (w > _MIN_INVERSE_DEPTH) & (sigma_w < _MAX_RELATIVE_DEPTH_SIGMA * w)
    rows = np.flatnonzero(usable)
    if len(rows) < 3 or count == 0:
        return np.zeros((0, 4, 4))
    triples = rows[rng.integers(0, len(rows), size=(count, 3))]
    distinct = (triples[:, 0] != triples[:, 1]) & (triples[:, 0] != triples[:, 2]) & (triples[:, 1] != triples[:, 2])
    poses, found = _resect_triples(triples[distinct], rig, observations, pair)
    body_T_left = rig.body_T_left[pair]
    return np.ascontiguousarray(body_T_left @ poses[found] @ se3_inverse(body_T_left))


def preempt(
    rig: RigArrays,
    observations: Observations,
    hypotheses: Float,
    chunk_points: int,
    cauchy_scale_px: float,
    rng: np.random.Generator,
) -> Float:
    """The hypothesis (4, 4) that survives when, chunk by chunk, the worse half is dropped.

    Every hypothesis is scored on a chunk of points of *each* pair; the scores cumulate. When the points are used up,
    the best score wins.
    """
    order: list[Int] = [rng.permutation(np.flatnonzero(observations.pair == j)) for j in range(len(rig.body_T_left))]
    alive = np.arange(len(hypotheses))
    scores = np.zeros(len(hypotheses))
    start = 0
    while len(alive) > 1:
        chunk = np.concatenate([rows[start : start + chunk_points] for rows in order])
        if len(chunk) == 0:
            break
        scores[alive] += score_all(hypotheses[alive], rig, observations, chunk, cauchy_scale_px)
        ranked = alive[np.argsort(scores[alive], kind="stable")]
        alive = ranked[: (len(ranked) + 1) // 2]
        start += chunk_points
    best = alive[np.argmin(scores[alive])]
    return np.asarray(hypotheses[best])


@kernel
def _explained_shares(cur_T_ref: Float, rig: RigArrays, observations: Observations, max_error_px: float) -> Float:
    """The share (P,) of each pair's points that a motion explains in both images; 0 for a pair without points."""
    motions = left_motions(cur_T_ref, rig)
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
def _resect_triples(triples: Int, rig: RigArrays, observations: Observations, pair: int) -> tuple[Float, Bool]:
    """For each triple of one pair's points the solution that the right image of the points likes best."""
    n = len(triples)
    best = np.zeros((n, 4, 4))
    found = np.zeros(n, dtype=np.bool_)
    corners = np.empty((3, 3))
    rays = np.empty((3, 3))
    points, left, right = observations.points, observations.left, observations.right
    right_T_left = np.ascontiguousarray(rig.cam_T_body[pair, 1]) @ np.ascontiguousarray(rig.body_T_left[pair])
    for i in range(n):
        for k in range(3):
            row = triples[i, k]
            w = points[row, 2]
            corners[k, 0], corners[k, 1], corners[k, 2] = points[row, 0] / w, points[row, 1] / w, 1.0 / w
            x, y = left[row, 0], left[row, 1]
            norm = np.sqrt(x * x + y * y + 1.0)
            rays[k, 0], rays[k, 1], rays[k, 2] = x / norm, y / norm, 1.0 / norm
        poses, count = resect(corners, rays)
        least = np.inf
        for c in range(count):
            motion = right_T_left @ poses[c]
            error = 0.0
            for k in range(3):
                row = triples[i, k]
                if observations.has_right[row]:
                    e2 = squared_error_px(motion, points[row], right[row], rig.focal_px[pair, 1])
                    error += min(e2, WORST)
            if error < least:
                least = error
                best[i] = poses[c]
                found[i] = True
    return best, found
