"""The bundle adjustment's normal equations against gtsam's factors, landmarks eliminated."""

import gtsam
import numpy as np
import pytest
from walked_views import Walk

from graphvio.arrays import Float
from graphvio.geometry import se3_adjoint, se3_compose, se3_exp, se3_inverse
from graphvio.rig import Camera, StereoPair
from graphvio.self_calibration.bundle import Eliminated, Tracks, eliminate_landmarks
from graphvio.self_calibration.parameters import PAIR, RigCalibration
from graphvio.simulation.default_rig import default_rig

SIGMA_PX, QUADRATIC = 0.3, 1e6
"""Noise, and a scale of the Cauchy cost at which it is that of least squares."""
DIMENSIONS = {"x": 6, "k": 9}
OF_GTSAM = [0, 1, 3, 4, 5, 6, 7, 8]
"""fx, fy, cx, cy, k1, k2, p1, p2 in gtsam's calibration, whose third element is the skew."""


def observed(has_right: bool) -> tuple[StereoPair, Float, Tracks, Float]:
    """One pair's view of some points from two poses, with the errors of their positions and of the poses."""
    rig, rng = default_rig().without_imu().with_pairs([0]), np.random.default_rng(3)
    walk, pair = Walk(rig, sigma_px=SIGMA_PX), rig.pairs[0]
    poses = np.array([walk.pose(0.0), walk.pose(0.4)])
    views = [walk.views(pose)[0] for pose in poses]
    ids = np.intersect1d(views[0].ids, views[1].ids)
    rows = [np.searchsorted(view.ids, ids) for view in views]
    both = np.logical_and(*(view.has_right[at] for view, at in zip(views, rows, strict=True)))
    rows = [at[both][:30] for at in rows]
    n = len(rows[0])
    left_px: Float = np.hstack([view.left_px[at] for view, at in zip(views, rows, strict=True)]).reshape(-1, 2)
    right_px: Float = np.hstack([view.right_px[at] for view, at in zip(views, rows, strict=True)]).reshape(-1, 2)
    frames = np.tile(se3_compose(poses[0], pair.left.body_T_cam), (n, 1, 1))
    tracks = Tracks(
        np.zeros(n, dtype=np.int64), frames, np.arange(0, 2 * n + 1, 2), np.tile([0, 1], n), left_px, right_px,
        np.full(2 * n, has_right), np.full(2 * n, SIGMA_PX),
    )  # fmt: skip
    bearings, _ = pair.left.unproject(np.ascontiguousarray(left_px[::2]))
    landmarks = np.column_stack([bearings, views[0].inverse_depths[rows[0]]])
    moved = np.array([se3_compose(pose, se3_exp(1e-3 * rng.standard_normal(6))) for pose in poses])
    return pair, moved, tracks, landmarks


def normal_equations(poses: Float, tracks: Tracks, landmarks: Float) -> tuple[Float, Float]:
    """Those of graphvio, over both poses and the pair's parameters."""
    calibration, size = RigCalibration.of(default_rig().without_imu().with_pairs([0])), 12 + PAIR
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    eliminate_landmarks(
        poses, calibration, landmarks, tracks, QUADRATIC, 0.0, hessian, gradient, Eliminated.empty(tracks)
    )
    return hessian, gradient


def in_odom(tracks: Tracks, landmarks: Float) -> Float:
    """Positions (L, 3) of the landmarks."""
    in_frame = np.column_stack([landmarks[:, :2], np.ones(len(landmarks))]) / landmarks[:, 2:]
    frames = tracks.odom_T_landmark
    return np.asarray(np.einsum("lij,lj->li", frames[:, :3, :3], in_frame) + frames[:, :3, 3])


def calibration_of(camera: Camera) -> gtsam.Cal3DS2:
    fx, fy, cx, cy = camera.intrinsics
    return gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, *camera.distortion[:4])


def without_landmarks(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: list[int]) -> tuple[Float, Float]:
    """Hessian and gradient of gtsam's graph over some variables, the others eliminated."""
    ordering = gtsam.Ordering()
    for key in (*keys, *(key for key in values.keys() if key not in keys)):  # noqa: SIM118
        ordering.push_back(key)
    hessian, information_vector = graph.linearize(values).hessian(ordering)
    kept = sum(DIMENSIONS[chr(gtsam.symbolChr(key))] for key in keys)
    across, eliminated = hessian[:kept, kept:], hessian[kept:, kept:]
    gain = np.linalg.solve(eliminated, across.T).T
    schur = hessian[:kept, :kept] - gain @ across.T
    return schur, -(information_vector[:kept] - gain @ information_vector[kept:])


@pytest.mark.parametrize("has_right", [True, False])
def test_poses_equal_those_of_projection_factors(has_right: bool) -> None:
    pair, poses, tracks, landmarks = observed(has_right)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_PX)
    for k, pose in enumerate(poses):
        values.insert(gtsam.symbol("x", k), gtsam.Pose3(pose))
    for point, position in enumerate(in_odom(tracks, landmarks)):
        values.insertPoint3(gtsam.symbol("l", point), position)
        for row in (2 * point, 2 * point + 1):
            for camera, pixels in ((pair.left, tracks.left_px), (pair.right, tracks.right_px))[: 1 + has_right]:
                at = gtsam.symbol("x", int(tracks.keyframe[row])), gtsam.symbol("l", point)
                lens, place = calibration_of(camera), gtsam.Pose3(camera.body_T_cam)
                graph.add(gtsam.GenericProjectionFactorCal3DS2(pixels[row], noise, *at, lens, place))
    expected = without_landmarks(graph, values, [gtsam.symbol("x", 0), gtsam.symbol("x", 1)])
    hessian, gradient = normal_equations(poses, tracks, landmarks)
    scale = np.sqrt(np.outer(np.diag(expected[0]), np.diag(expected[0])))
    np.testing.assert_allclose(hessian[:12, :12] / scale, expected[0] / scale, atol=1e-7)
    np.testing.assert_allclose(gradient[:12] / np.diag(scale), expected[1] / np.diag(scale), atol=1e-7)


def test_lens_parameters_equal_those_of_factors_with_the_calibration_as_unknown() -> None:
    pair, poses, tracks, landmarks = observed(has_right=False)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise, lens = gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_PX), gtsam.symbol("k", 0)
    values.insert(lens, calibration_of(pair.left))
    for k, pose in enumerate(poses):
        values.insert(gtsam.symbol("x", k), gtsam.Pose3(se3_compose(pose, pair.left.body_T_cam)))
    for point, position in enumerate(in_odom(tracks, landmarks)):
        values.insertPoint3(gtsam.symbol("l", point), position)
        for row in (2 * point, 2 * point + 1):
            at = gtsam.symbol("x", int(tracks.keyframe[row])), gtsam.symbol("l", point), lens
            graph.add(gtsam.GeneralSFMFactor2Cal3DS2(tracks.left_px[row], noise, *at))
    hessian, gradient = without_landmarks(graph, values, [gtsam.symbol("x", 0), gtsam.symbol("x", 1), lens])
    # A step of body moves its camera by the adjoint.
    jacobian = np.zeros((12 + 9, 12 + 8))
    jacobian[:6, :6] = jacobian[6:12, 6:12] = se3_adjoint(se3_inverse(pair.left.body_T_cam))
    jacobian[12 + np.array(OF_GTSAM), 12 + np.arange(8)] = 1.0
    expected, expected_gradient = jacobian.T @ hessian @ jacobian, jacobian.T @ gradient
    found, found_gradient = (each[..., :20] for each in normal_equations(poses, tracks, landmarks))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found[:20] / scale, expected / scale, atol=1e-7)
    np.testing.assert_allclose(found_gradient / np.diag(scale), expected_gradient / np.diag(scale), atol=1e-7)
