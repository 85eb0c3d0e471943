"""Calibration by both methods from pose pairs with synthetic errors, on the walk of the scene ``calibration``."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from graphvio.calibration import graph, paper_method
from graphvio.calibration.comparison import compare
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.geometry import se3_exp, se3_inverse, se3_log
from graphvio.simulation import build_scene
from graphvio.simulation.default_rig import default_rig

PAIRS = 300
INTERVAL_S = 0.35
_RANDOM_TURN, _RANDOM_STEP_M = 0.15, 0.1  # sigmas of outliers' rotations, radians, and translations, about each axis


class Run(NamedTuple):
    """Result of one run.

    Attributes:
        rotation_rad: rotation error of the graph's result.
        translation_m: translation error of the graph's result.
        paper_rotation_rad: rotation error of the paper's method.
        paper_translation_m: translation error of the paper's method.
        square: squared Mahalanobis distance of the graph's result from the truth.
        outliers_kept: number of outliers that were taken for inliers.
        outliers: number of sampled outliers.
        inliers_lost: number of other pose pairs that were taken for outliers.
        agrees: whether the comparison of the two methods found that they agree.
    """

    rotation_rad: float
    translation_m: float
    paper_rotation_rad: float
    paper_translation_m: float
    square: float
    outliers_kept: int
    outliers: int
    inliers_lost: int
    agrees: bool


def one_run(seed: int, rotation_rad: float, translation_m: float, outlier_share: float) -> Run:
    """Sample pose pairs, calibrate by both methods, and compare the results with the truth.

    Args:
        seed: seed of errors and outliers, and of the method's random triples.
        rotation_rad: sigma of each motion's rotation, about each axis.
        translation_m: sigma of each motion's translation, along each axis.
        outlier_share: share of the second camera's motions that are random, and independent of the first camera's.
    """
    rng = np.random.default_rng(seed)
    rig = default_rig()
    motion = build_scene("calibration", (PAIRS + 1) * INTERVAL_S, 0.0).motion
    poses = motion.at(np.arange(PAIRS + 1, dtype=np.float64) * INTERVAL_S).world_T_body
    sigmas = np.repeat([rotation_rad, translation_m], 3)
    cameras = []
    for pair in rig.pairs:
        lefts = poses @ pair.left.body_T_cam
        exact = [se3_inverse(np.ascontiguousarray(a)) @ b for a, b in pairwise(lefts)]
        cameras.append(np.array([each @ se3_exp(sigmas * rng.standard_normal(6)) for each in exact]))
    outlier = rng.random(PAIRS) < outlier_share
    random = np.repeat([_RANDOM_TURN, _RANDOM_STEP_M], 3)
    for k in np.flatnonzero(outlier):
        cameras[1][k] = se3_exp(random * rng.standard_normal(6))
    covariance = np.tile(np.diag(sigmas**2), (PAIRS, 1, 1))
    stamps = (np.arange(PAIRS + 1) * INTERVAL_S * 1e9).astype(np.int64)
    pairs = PosePairs(stamps[:-1], stamps[1:], cameras[0], covariance, cameras[1], covariance)
    paper = paper_method.calibrate(pairs, seed)
    found = graph.solve(pairs, paper.left2_T_left1)
    truth = np.ascontiguousarray(rig.left2_T_left1())
    off, paper_off = (se3_log(se3_inverse(each) @ truth) for each in (found.left2_T_left1, paper.left2_T_left1))
    return Run(
        float(np.linalg.norm(off[:3])),
        float(np.linalg.norm(off[3:])),
        float(np.linalg.norm(paper_off[:3])),
        float(np.linalg.norm(paper_off[3:])),
        float(off @ np.linalg.solve(found.covariance, off)),
        int((found.inlier & outlier).sum()),
        int(outlier.sum()),
        int((~found.inlier & ~outlier).sum()),
        compare(pairs, paper, found).agrees,
    )
