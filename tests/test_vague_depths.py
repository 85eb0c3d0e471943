"""Motion of a pair and a single camera whose points have no depth yet, or depths of a wrong scale, by Monte Carlo.

Images have less noise than the configuration says, as on most recordings. Bands of the mean are those of cautious
covariances: an overconfident one is what the odometry cannot recover from.
"""

import numpy as np
import pytest

from graphvio.arrays import Float
from graphvio.config.stages import MotionConfig
from graphvio.frontend.depth.motion_stereo import PRIOR_INVERSE_DEPTH
from graphvio.frontend.depth.stereo import triangulate
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.refinement import Refined
from graphvio.frontend.motion.selection import joint_motion, searched_and_refined
from graphvio.geometry import se3, se3_inverse, se3_log, so3_exp
from graphvio.simulation.named_rigs import stereo_and_back

RIG, CONFIG = stereo_and_back(), MotionConfig()
PAIR, SINGLE = RIG.pairs[0], RIG.singles[0].left
PAIR_PX, SINGLE_PX, PRIOR_SIGMA = 0.06, 0.02, 10.0
DRAWS, N = 60, 150
MOTIONS = {
    "standstill": np.eye(4),
    "a tenth of a millimetre": se3(np.eye(3), np.array([1e-4, 0.0, 0.0])),
    "two centimetres": se3(so3_exp(np.array([0.01, -0.02, 0.005])), np.array([0.015, -0.01, 0.005])),
}


def seen(points: Float, cam_T_points: Float, noise_px: float, focal_px: float, rng: np.random.Generator) -> Float:
    """Normalised coordinates (N, 2) of points (N, 3), with noise."""
    there = points @ cam_T_points[:3, :3].T + cam_T_points[:3, 3]
    return np.asarray(there[:, :2] / there[:, 2:] + noise_px / focal_px * rng.standard_normal((len(points), 2)))


def observed(cur_T_ref: Float, rng: np.random.Generator, scale: float | None = None) -> Observations:
    """Points of both, 1 to 6 m away, at two instants.

    The single camera's inverse depths are known to 1 %, but for a common scale; or not at all without a scale.
    """
    parts = []
    for j, camera in enumerate((PAIR.left, SINGLE)):
        depths = rng.uniform(1.0, 6.0, N)
        points = np.column_stack([rng.uniform(-0.7, 0.7, (N, 2)) * depths[:, None], depths])
        noise_px, focal_px = (PAIR_PX if j == 0 else SINGLE_PX), camera.focal_px
        moved = camera.cam_T_body @ cur_T_ref @ camera.body_T_cam
        then = seen(points, np.eye(4), noise_px, focal_px, rng)
        now = seen(points, moved, noise_px, focal_px, rng)
        right = np.zeros((N, 2))
        if j == 0:
            right_then = seen(points, PAIR.right_T_left, noise_px, focal_px, rng)
            right = seen(points, PAIR.right_T_left @ moved, noise_px, focal_px, rng)
            located, covariances, _ = triangulate(then, right_then, PAIR.right_T_left, focal_px, PAIR.right.focal_px)
        else:
            inverse, sigma = np.full(N, PRIOR_INVERSE_DEPTH), np.full(N, PRIOR_SIGMA)
            if scale is not None:
                inverse, sigma = scale / depths * rng.normal(1.0, 0.01, N), 0.01 / depths
            located = np.column_stack([then, inverse])
            covariances = np.tile(focal_px**-2 * np.eye(3), (N, 1, 1))
            covariances[:, 2, 2] = (sigma / CONFIG.pixel_sigma_px) ** 2
        parts.append(Observations(np.full(N, j), located, covariances, now, right, np.full(N, j == 0)))
    return Observations(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def nees(found: Refined, cur_T_ref: Float) -> float:
    error = se3_log(np.ascontiguousarray(found.cur_T_ref @ se3_inverse(cur_T_ref)))
    return float(error @ np.linalg.solve(found.covariance, error)) / 6.0


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_with_vague_depths_is_as_wrong_as_its_covariance_says(name: str) -> None:
    motion, arrays, values, sizes = MOTIONS[name], RigArrays.of(RIG), [], []
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        observations = observed(motion, rng)
        found, _ = joint_motion(arrays, observations, np.eye(4), CONFIG, rng)
        alone = searched_and_refined(arrays, observations.of_pair(0), np.eye(4), CONFIG, rng)
        values.append(nees(found, motion))
        sizes.append(np.linalg.det(found.covariance) / np.linalg.det(alone.covariance))
    assert 0.4 < np.mean(values) < 1.2
    assert np.median(sizes) < 1.0


@pytest.mark.parametrize("sigma", [0.0, 0.001, 0.004])
def test_scale_of_a_single_cameras_depths_does_not_scale_the_motion(sigma: float) -> None:
    """The pair knows how long the step is; how the rig turned and where it went, both know better than the pair."""
    motion, arrays = se3(so3_exp(np.array([0.01, -0.02, 0.005])), np.array([0.12, -0.03, 0.02])), RigArrays.of(RIG)
    values: list[float] = []
    lengths, turned = np.empty((2, DRAWS)), np.empty((2, DRAWS))  # of both, and of the pair alone
    for seed in range(DRAWS):
        rng = np.random.default_rng([1, seed])
        observations = observed(motion, rng, scale=float(np.exp(sigma * rng.standard_normal())))
        found, _ = joint_motion(arrays, observations, np.eye(4), CONFIG, rng)
        alone = searched_and_refined(arrays, observations.of_pair(0), np.eye(4), CONFIG, rng)
        values.append(nees(found, motion))
        for k, each in enumerate((found, alone)):
            lengths[k, seed] = np.linalg.norm(each.cur_T_ref[:3, 3])
            turned[k, seed] = np.linalg.norm(se3_log(each.cur_T_ref @ se3_inverse(motion))[:3])
    assert 0.3 < np.mean(values) < 1.2
    assert np.std(lengths[0]) < 1.1 * np.std(lengths[1])
    assert np.median(turned[0]) < 0.7 * np.median(turned[1])
