"""What errors of the calibration add to a motion's innovation, against motions with such errors."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3, se3_exp, se3_inverse, se3_log, so3_exp, so3_log
from graphvio.self_calibration.imu_model import ACCEL_MATRIX, GYRO_MATRIX, PARAMETERS, TIME_OFFSET
from graphvio.self_calibration.innovation import InnovationErrors
from graphvio.self_calibration.parameters import BODY, PAIR, RigCalibration
from graphvio.simulation.default_rig import default_rig

IMU = 2 * PAIR
MOTION = se3(so3_exp(np.array([0.1, -0.25, 0.2])), np.array([0.3, -0.1, 0.2]))
SAMPLES = 4000


def covariance_with(at: int, block: Float) -> Float:
    covariance = np.zeros((IMU + PARAMETERS, IMU + PARAMETERS))
    covariance[at : at + len(block), at : at + len(block)] = block
    return covariance


def assert_sampled(errors: Float, covariance: Float) -> None:
    sampled = errors.T @ errors / len(errors)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(sampled, covariance, atol=0.1 * scale.max())
    assert np.linalg.norm(covariance) > 0.0


def test_innovation_errors_of_the_place_in_body_are_those_of_motions_by_wrong_cameras() -> None:
    rng, sigmas, nominal = np.random.default_rng(1), np.repeat([0.01, 0.02], 3), default_rig()
    errors = InnovationErrors(covariance_with(BODY, np.diag(sigmas**2)), nominal)
    found = []
    for place in sigmas * rng.normal(size=(SAMPLES, 6)):
        difference = np.zeros(IMU)
        difference[BODY:PAIR] = place
        moved = RigCalibration.of(nominal).moved(difference).body_T_left[0]
        error = moved @ nominal.pairs[0].left.cam_T_body
        found.append(se3_log(se3_inverse(MOTION) @ error @ MOTION @ se3_inverse(error)))
    assert_sampled(np.array(found), errors.covariance(MOTION, None, None))


def test_innovation_errors_of_another_pairs_place_are_those_of_motions_by_it() -> None:
    rng, sigmas, nominal = np.random.default_rng(5), np.repeat([0.01, 0.02], 3), default_rig()
    errors = InnovationErrors(covariance_with(PAIR + BODY, np.diag(sigmas**2)), nominal)
    found = []
    for place in sigmas * rng.normal(size=(SAMPLES, 6)):
        difference = np.zeros(IMU)
        difference[PAIR + BODY :] = place
        moved = RigCalibration.of(nominal).moved(difference).body_T_left[1]
        error = moved @ nominal.pairs[1].left.cam_T_body
        found.append(se3_log(se3_inverse(MOTION) @ error @ MOTION @ se3_inverse(error)))
    assert_sampled(np.array(found), errors.of_other_extrinsics(1, MOTION))
    assert not errors.of_other_extrinsics(0, MOTION).any()


def test_innovation_errors_of_the_gyros_matrix_are_those_of_rates_by_a_wrong_matrix() -> None:
    rng, sigma, phi = np.random.default_rng(2), 0.01, so3_log(MOTION)
    root = sigma * (np.eye(9) + 0.3 * rng.normal(size=(9, 9)))
    errors = InnovationErrors(covariance_with(IMU + GYRO_MATRIX, root @ root.T), default_rig())
    assert GYRO_MATRIX + 9 == ACCEL_MATRIX
    matrices = (rng.normal(size=(SAMPLES, 9)) @ root.T).reshape(-1, 3, 3)
    found = np.zeros((SAMPLES, 6))
    found[:, :3] = [so3_log(so3_exp(phi).T @ so3_exp(phi + matrix @ phi)) for matrix in matrices]
    covariance = errors.covariance(MOTION, None, None)
    assert_sampled(found, covariance)
    assert not covariance[3:].any()


def test_innovation_errors_of_the_time_offset_are_those_of_a_later_motion() -> None:
    before, now = np.array([0.2, -0.1, 0.4, 1.0, 0.3, 0.0]), np.array([0.9, 0.5, -0.2, 0.7, -0.2, 0.4])
    sigma_s = 0.004
    errors = InnovationErrors(covariance_with(IMU + TIME_OFFSET, np.array([[sigma_s**2]])), default_rig())
    later = se3_inverse(se3_exp(sigma_s * before)) @ MOTION @ se3_exp(sigma_s * now)
    change = se3_log(se3_inverse(MOTION) @ later)
    expected = np.outer(change, change)
    np.testing.assert_allclose(errors.covariance(MOTION, before, now), expected, atol=0.02 * np.abs(expected).max())
    assert not errors.covariance(MOTION, None, now).any()


def test_innovation_errors_of_a_standstill_are_none() -> None:
    errors = InnovationErrors(0.01 * np.eye(IMU + PARAMETERS), default_rig())
    np.testing.assert_allclose(errors.covariance(np.eye(4), np.zeros(6), np.zeros(6)), 0.0, atol=1e-15)
