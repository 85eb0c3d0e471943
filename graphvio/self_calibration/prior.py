"""What is known of a rig's calibration beforehand: the covariance of the rig file's values."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.calibration_sigmas import CalibrationSigmas
from graphvio.geometry import skew
from graphvio.rig import Rig, StereoPair
from graphvio.self_calibration.evidence import FilePrior, Gaussian
from graphvio.self_calibration.imu_model import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    GYRO_BIAS,
    GYRO_MATRIX,
    PARAMETERS,
    TIME_OFFSET,
)
from graphvio.self_calibration.parameters import (
    BODY,
    CAMERA,
    DISTORTION,
    INTRINSICS,
    PAIR,
    STEREO,
    is_linear,
    relative_to_first,
)

_MIN_DISTORTION = 0.005  # of a coefficient, from which its standard deviation is a share of it
_MIN_SIGMA = 1e-9
_GYRO_BIAS_SIGMA_RAD_S, _ACCEL_BIAS_SIGMA_M_S2 = 0.05, 0.3
_BIAS_WALK_FACTOR = 2.0  # on the stated random walks, which are those of a sensor at one temperature


_CAMERAS, _PLACES, _NO_GROUP = 0, 1, -1  # groups of parameters whose errors have a common factor


def file_prior(rig: Rig) -> FilePrior:
    """Return the prior of all parameters of a rig, of its pairs and its IMU, by its `CalibrationSigmas`.

    Cameras and left to right are one group, the places of the pairs and the IMU another one.
    """
    of_pairs = _covariance_of_pairs(rig)
    n = len(of_pairs)
    group = np.full(n, _CAMERAS)
    group.reshape(-1, PAIR)[:, BODY:] = _PLACES
    if rig.imu is None:
        return FilePrior(of_pairs, group)
    covariance = np.zeros((n + PARAMETERS, n + PARAMETERS))
    covariance[:n, :n] = of_pairs
    covariance[n:, n:] = np.diag(_sigmas_of_imu(rig.calibration_sigmas) ** 2)
    of_imu = np.full(PARAMETERS, _PLACES)
    of_imu[:GYRO_MATRIX] = _NO_GROUP
    return FilePrior(covariance, np.concatenate([group, of_imu]))


def walk_per_second(rig: Rig, prior: FilePrior, share: float) -> Float:
    """Return the covariance (C, C) of what a calibration changes in one second, by heat and the like.

    Args:
        rig: of the prior; its IMU states the random walk of the biases.
        prior: of the calibration.
        share: standard deviation of the others, as a share of the prior's.
    """
    walk = share**2 * prior.covariance
    if rig.imu is not None:
        biases = PAIR * len(rig.pairs) + np.arange(GYRO_BIAS, GYRO_MATRIX)
        walks = np.repeat([rig.imu.gyro_random_walk, rig.imu.accel_random_walk], 3)
        walk[biases, biases] = (_BIAS_WALK_FACTOR * walks) ** 2
    return walk


def extrinsic_covariances(rig: Rig, posterior: Gaussian) -> dict[int, Float]:
    """Return the covariances of the pairs' places relative to the first pair.

    Returns:
        Pair index, of all but the first -> covariance (6, 6) of the error d of extrinsics ``exp(d) body_T_left``.
    """
    n = PAIR * len(rig.pairs)
    of_pairs, found = posterior.covariance[:n, :n], {}
    for j, pair in enumerate(rig.pairs[1:], start=1):
        about_origin = np.eye(6)  # of body, and not about the camera
        about_origin[3:, :3] = skew(pair.left.body_T_cam[:3, 3])
        rows = about_origin @ relative_to_first(rig, j)
        found[j] = rows @ of_pairs @ rows.T
    return found


def refined_sigmas(rig: Rig, posterior: Gaussian) -> CalibrationSigmas:
    """Return the standard deviations of a posterior, of each kind of parameter the largest.

    Args:
        rig: with the calibration of the posterior.
        posterior: of the difference from a rig file.
    """
    covariance = posterior.covariance
    of_pair = [_sigmas(covariance, slice(j * PAIR, (j + 1) * PAIR)) for j in range(len(rig.pairs))]
    first, stereo_at = of_pair[0][BODY:], slice(STEREO, STEREO + 3)
    of_pairs = covariance[: PAIR * len(rig.pairs), : PAIR * len(rig.pairs)]
    rows = [relative_to_first(rig, j) for j in range(1, len(rig.pairs))]
    relative = [np.sqrt(np.diag(each @ of_pairs @ each.T)) for each in rows] or [first]
    cameras = [
        (camera, of_pair[j][which * CAMERA : (which + 1) * CAMERA])
        for j, pair in enumerate(rig.pairs)
        for which, camera in enumerate((pair.left, pair.right))
    ]
    known = rig.calibration_sigmas
    imu = _sigmas(covariance, slice(-PARAMETERS, None)) if rig.imu is not None else _sigmas_of_imu(known)
    matrix = imu[GYRO_MATRIX:TIME_OFFSET].reshape(2, 3, 3)
    diagonal = np.diagonal(matrix, axis1=1, axis2=2)
    return CalibrationSigmas(
        focal_share=max(float((sigmas[:2] / camera.intrinsics[:2]).max()) for camera, sigmas in cameras),
        principal_point_px=max(float(sigmas[2:INTRINSICS].max()) for _, sigmas in cameras),
        distortion_share=known.distortion_share,
        stereo_rotation_deg=float(np.rad2deg(max(sigmas[stereo_at].max() for sigmas in of_pair))),
        stereo_baseline_share=max(
            float(sigmas[STEREO + 3 : BODY].max()) / pair.baseline_m
            for sigmas, pair in zip(of_pair, rig.pairs, strict=True)
        ),
        body_rotation_deg=float(np.rad2deg(first[:3].max())),
        body_translation_m=float(first[3:].max()),
        pair_rotation_deg=float(np.rad2deg(max(sigmas[:3].max() for sigmas in relative))),
        pair_translation_m=float(max(sigmas[3:].max() for sigmas in relative)),
        time_offset_s=float(imu[TIME_OFFSET]),
        imu_scale_share=float(diagonal.max()),
        imu_misalignment_deg=float(np.rad2deg(matrix[:, ~np.eye(3, dtype=bool)].max())),
    )


def _sigmas(covariance: Float, rows: slice) -> Float:
    return np.asarray(np.sqrt(np.diag(covariance)[rows]))


def _sigmas_of_imu(known: CalibrationSigmas) -> Float:
    """Return the standard deviations (25,) of the IMU's parameters, see `graphvio.self_calibration.imu_model`."""
    sigmas = np.empty(PARAMETERS)
    sigmas[GYRO_BIAS:ACCEL_BIAS], sigmas[ACCEL_BIAS:GYRO_MATRIX] = _GYRO_BIAS_SIGMA_RAD_S, _ACCEL_BIAS_SIGMA_M_S2
    matrix = np.full((3, 3), np.deg2rad(known.imu_misalignment_deg))
    np.fill_diagonal(matrix, known.imu_scale_share)
    sigmas[GYRO_MATRIX:ACCEL_MATRIX] = sigmas[ACCEL_MATRIX:TIME_OFFSET] = matrix.ravel()
    sigmas[TIME_OFFSET] = known.time_offset_s
    return sigmas


def _covariance_of_pairs(rig: Rig) -> Float:
    """Return the covariance of the pairs' parameters, see `graphvio.self_calibration.parameters`."""
    known, n_pairs = rig.calibration_sigmas, len(rig.pairs)
    covariance = np.zeros((n_pairs * PAIR, n_pairs * PAIR))
    for j, pair in enumerate(rig.pairs):
        of_pair = slice(j * PAIR, j * PAIR + BODY)
        covariance[of_pair, of_pair] = np.diag(np.maximum(_sigmas_of_pair(pair, known), _MIN_SIGMA) ** 2)
    common = np.repeat([np.deg2rad(known.body_rotation_deg), known.body_translation_m], 3) ** 2
    single = np.repeat([np.deg2rad(known.pair_rotation_deg), known.pair_translation_m], 3) ** 2
    by_common = np.zeros((n_pairs * PAIR, 6))  # body turns about its origin, which moves the cameras in it
    for j, pair in enumerate(rig.pairs):
        place = slice(j * PAIR + BODY, (j + 1) * PAIR)
        by_common[place] = np.eye(6)
        by_common[place][3:, :3] = -skew(pair.left.body_T_cam[:3, 3])
        if j > 0:
            covariance[place, place] = np.diag(single)
    covariance += (by_common * common) @ by_common.T
    return covariance


def _sigmas_of_pair(pair: StereoPair, known: CalibrationSigmas) -> Float:
    """Return the standard deviations (BODY,) of a pair's cameras and of left to right."""
    sigmas = np.zeros(BODY)
    for which, camera in enumerate((pair.left, pair.right)):
        at = which * CAMERA
        sigmas[at : at + 2] = known.focal_share * camera.intrinsics[:2]
        sigmas[at + 2 : at + INTRINSICS] = known.principal_point_px
        given = np.where(is_linear(camera), camera.distortion[:DISTORTION], 0.0)
        size = np.where(given != 0.0, np.maximum(np.abs(given), _MIN_DISTORTION), 0.0)
        sigmas[at + INTRINSICS : at + CAMERA] = known.distortion_share * size
    sigmas[STEREO : STEREO + 3] = np.deg2rad(known.stereo_rotation_deg)
    sigmas[STEREO + 3 :] = known.stereo_baseline_share * pair.baseline_m
    return sigmas
