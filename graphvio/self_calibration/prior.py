"""Prior of a rig's calibration: the covariance of the rig file's values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphvio.arrays import Float
from graphvio.calibration_sigmas import CalibrationSigmas
from graphvio.geometry import skew
from graphvio.linear_algebra import cholesky
from graphvio.rig import Camera, Rig, StereoPair
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
    STEREO,
    about_origin,
    extrinsics_of,
    has_coefficient,
    n_camera_parameters,
    relative_to_first,
    slices_of_groups,
)

_MIN_DISTORTION = 0.005  # size of a coefficient from which on its standard deviation is a share of it
_MIN_SIGMA = 1e-9
_GYRO_BIAS_SIGMA_RAD_S, _ACCEL_BIAS_SIGMA_M_S2 = 0.05, 0.3
SINGLE_FOCAL_SHARE, SINGLE_CENTRE_PX = 0.002, 1.0
"""Errors of a single camera's lens that no covariance includes: in real images, its tracks have errors in common."""
_BIAS_WALK_FACTOR = 2.0  # on the stated random walks, which are those of a sensor at one temperature


_CAMERAS, _EXTRINSICS, _NO_GROUP = 0, 1, -1  # groups of parameters whose errors have a common factor
_CAMERA_SIGMAS = (
    "focal_share", "principal_point_px", "distortion_share", "stereo_rotation_deg", "stereo_baseline_share"
)  # fmt: skip
"""Standard deviations of the first group."""


def file_prior(rig: Rig) -> FilePrior:
    """Return the prior of all parameters of a rig, of its cameras and its IMU, by its `CalibrationSigmas`.

    Intrinsics and stereo extrinsics are one group, extrinsics in body and the IMU another one.
    """
    of_cameras = _covariance_of_cameras(rig)
    n = len(of_cameras)
    group = np.full(n, _CAMERAS)
    for j in range(len(rig.groups)):
        group[extrinsics_of(rig, j)] = _EXTRINSICS
    estimated = rig.calibration_sigmas.estimated
    if rig.imu is None:
        return FilePrior(of_cameras, group, estimated=estimated)
    covariance = np.zeros((n + PARAMETERS, n + PARAMETERS))
    covariance[:n, :n] = of_cameras
    covariance[n:, n:] = np.diag(_sigmas_of_imu(rig.calibration_sigmas) ** 2)
    of_imu = np.full(PARAMETERS, _EXTRINSICS)
    of_imu[:GYRO_MATRIX] = _NO_GROUP
    return FilePrior(covariance, np.concatenate([group, of_imu]), estimated=estimated)


def walk_per_second(rig: Rig, prior: FilePrior, share: float) -> Float:
    """Return the covariance (C, C) of a calibration's random walk in one second, by heat and the like.

    Args:
        rig: rig of the prior; its IMU states the random walk of the biases.
        prior: prior of the calibration.
        share: standard deviation of the other parameters' walk, as a share of the prior's.
    """
    walk = share**2 * prior.covariance
    if rig.imu is not None:
        biases = n_camera_parameters(rig) + np.arange(GYRO_BIAS, GYRO_MATRIX)
        walks = np.repeat([rig.imu.gyro_random_walk, rig.imu.accel_random_walk], 3)
        walk[biases, biases] = (_BIAS_WALK_FACTOR * walks) ** 2
    return walk


def extrinsic_covariances(rig: Rig, covariance: Float) -> dict[int, Float]:
    """Return the covariances of the extrinsics of pairs and single cameras relative to the first pair.

    Args:
        rig: rig of G pairs and single cameras.
        covariance: (C, C) covariance of the calibration.

    Returns:
        Index of each pair and single camera but the first -> covariance (6, 6) of the error d of extrinsics ``exp(d)
        body_T_left``.
    """
    n = n_camera_parameters(rig)
    of_cameras, found = covariance[:n, :n], {}
    for j in range(1, len(rig.groups)):
        rows = about_origin(rig, j) @ relative_to_first(rig, j)
        found[j] = rows @ of_cameras @ rows.T
    return found


def refined_sigmas(rig: Rig, posterior: Gaussian, factors: Float) -> CalibrationSigmas:
    """Return the standard deviations of a posterior for a rig file: of each kind of parameter the largest.

    A rig file's standard deviations contain no correlations, such as those of the baselines with the accelerometer's
    scale, which measurements show only relative to each other: as a prior, they would let the next run take each as
    known by itself. They are enlarged by one factor, until that prior is in no direction narrower than the posterior,
    but not beyond what was known before.

    Args:
        rig: rig with the calibration of the posterior, and the standard deviations of the rig file.
        posterior: posterior of the difference from the rig file.
        factors: (2,) factors on the file's standard deviations, with which the posterior was computed.
    """
    covariance, known = posterior.covariance, rig.calibration_sigmas
    of_cameras = covariance[: n_camera_parameters(rig), : n_camera_parameters(rig)]
    of_group = [_sigmas(covariance, own) for own in slices_of_groups(rig)]
    first = of_group[0][-6:]
    rows = [relative_to_first(rig, j) for j in range(1, len(rig.groups))]
    relative = [np.sqrt(np.diag(each @ of_cameras @ each.T)) for each in rows] or [first]
    cameras = [
        (camera, of_group[j][which * CAMERA : (which + 1) * CAMERA])
        for j, group in enumerate(rig.groups)
        for which, camera in enumerate(group.cameras)
    ]
    stereo_deg, baseline_share = known.stereo_rotation_deg, known.stereo_baseline_share
    if rig.pairs:
        of_stereo = [(pair, of_group[j][STEREO:BODY]) for j, pair in enumerate(rig.pairs)]
        stereo_deg = float(np.rad2deg(max(sigmas[:3].max() for _, sigmas in of_stereo)))
        baseline_share = max(float(sigmas[3:].max()) / pair.baseline_m for pair, sigmas in of_stereo)
    focal_share = max(float((sigmas[:2] / camera.intrinsics[:2]).max()) for camera, sigmas in cameras)
    centre_px = max(float(sigmas[2:INTRINSICS].max()) for _, sigmas in cameras)
    if not rig.pairs:
        focal_share, centre_px = (
            float(np.hypot(focal_share, SINGLE_FOCAL_SHARE)),
            float(np.hypot(centre_px, SINGLE_CENTRE_PX)),
        )
    # Cameras of rectified images have no coefficients.
    distortion_share = max(float(_distortion_shares(camera, sigmas).max()) for camera, sigmas in cameras)
    imu = _sigmas(covariance, slice(-PARAMETERS, None)) if rig.imu is not None else _sigmas_of_imu(known)
    matrix = imu[GYRO_MATRIX:TIME_OFFSET].reshape(2, 3, 3)
    diagonal = np.diagonal(matrix, axis1=1, axis2=2)
    found = CalibrationSigmas(
        focal_share=focal_share,
        principal_point_px=centre_px,
        distortion_share=distortion_share or known.distortion_share,
        stereo_rotation_deg=stereo_deg,
        stereo_baseline_share=baseline_share,
        body_rotation_deg=float(np.rad2deg(first[:3].max())),
        body_translation_m=float(first[3:].max()),
        pair_rotation_deg=float(np.rad2deg(max(sigmas[:3].max() for sigmas in relative))),
        pair_translation_m=float(max(sigmas[3:].max() for sigmas in relative)),
        time_offset_s=float(imu[TIME_OFFSET]),
        imu_scale_share=float(diagonal.max()),
        imu_misalignment_deg=float(np.rad2deg(matrix[:, ~np.eye(3, dtype=bool)].max())),
    )
    prior = file_prior(replace(rig, calibration_sigmas=found))
    enlarged = found.scaled(max(_largest_ratio(prior, covariance), 1.0)).values
    of_file = _scaled(known, factors).values
    bounded = {name: max(sigma, min(enlarged[name], of_file[name])) for name, sigma in found.values.items()}
    return CalibrationSigmas(**bounded, estimated=True)


def _largest_ratio(prior: FilePrior, covariance: Float) -> float:
    """Return the largest ratio in any direction of standard deviations of a covariance (C, C) to those of a prior."""
    with_factor = np.ix_(prior.group >= 0, prior.group >= 0)
    of_file = cholesky(np.ascontiguousarray(prior.covariance[with_factor]))
    half = np.linalg.solve(of_file, covariance[with_factor])
    return float(np.sqrt(np.linalg.eigvalsh(np.linalg.solve(of_file, half.T))[-1]))


def _scaled(known: CalibrationSigmas, factors: Float) -> CalibrationSigmas:
    """Return the standard deviations of a rig file that is wrong by some factors (2,), see `file_prior`."""
    of_cameras, of_extrinsics = (known.scaled(float(factor)).values for factor in factors)
    values = of_extrinsics | {name: of_cameras[name] for name in _CAMERA_SIGMAS}
    return CalibrationSigmas(**values, estimated=known.estimated)


def _distortion_shares(camera: Camera, sigmas: Float) -> Float:
    """Return the standard deviations (DISTORTION,) of a camera's coefficients as shares of `_distortion_sizes`."""
    size = _distortion_sizes(camera)
    return np.divide(sigmas[INTRINSICS:], size, out=np.zeros(DISTORTION), where=size > 0.0)


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


def _covariance_of_cameras(rig: Rig) -> Float:
    """Return the covariance of the cameras' parameters, see `graphvio.self_calibration.parameters`."""
    known, n = rig.calibration_sigmas, n_camera_parameters(rig)
    covariance = np.zeros((n, n))
    own = [_sigmas_of_pair(pair, known) for pair in rig.pairs]
    own += [_sigmas_of_lens(single.left, known) for single in rig.singles]
    common = np.repeat([np.deg2rad(known.body_rotation_deg), known.body_translation_m], 3) ** 2
    single = np.repeat([np.deg2rad(known.pair_rotation_deg), known.pair_translation_m], 3) ** 2
    by_common = np.zeros((len(covariance), 6))  # body turns about its origin, which moves the cameras in it
    for j, (group, sigmas) in enumerate(zip(rig.groups, own, strict=True)):
        extrinsics = extrinsics_of(rig, j)
        inner = slice(slices_of_groups(rig)[j].start, extrinsics.start)
        covariance[inner, inner] = np.diag(np.maximum(sigmas, _MIN_SIGMA) ** 2)
        by_common[extrinsics] = np.eye(6)
        by_common[extrinsics][3:, :3] = -skew(group.left.body_T_cam[:3, 3])
        if j > 0:
            covariance[extrinsics, extrinsics] = np.diag(single)
    covariance += (by_common * common) @ by_common.T
    return covariance


def _sigmas_of_pair(pair: StereoPair, known: CalibrationSigmas) -> Float:
    """Return the standard deviations (BODY,) of a pair's intrinsics and stereo extrinsics."""
    sigmas = np.zeros(BODY)
    for which, camera in enumerate(pair.cameras):
        sigmas[which * CAMERA : (which + 1) * CAMERA] = _sigmas_of_lens(camera, known)
    sigmas[STEREO : STEREO + 3] = np.deg2rad(known.stereo_rotation_deg)
    sigmas[STEREO + 3 :] = known.stereo_baseline_share * pair.baseline_m
    return sigmas


def _sigmas_of_lens(camera: Camera, known: CalibrationSigmas) -> Float:
    """Return the standard deviations (CAMERA,) of a camera's lens."""
    sigmas = np.zeros(CAMERA)
    sigmas[:2] = known.focal_share * camera.intrinsics[:2]
    sigmas[2:INTRINSICS] = known.principal_point_px
    sigmas[INTRINSICS:] = known.distortion_share * _distortion_sizes(camera)
    return sigmas


def _distortion_sizes(camera: Camera) -> Float:
    """Return the size (DISTORTION,) of each coefficient that its standard deviation is a share of; 0 for none."""
    given = np.where(has_coefficient(camera), camera.distortion[:DISTORTION], 0.0)
    return np.where(given != 0.0, np.maximum(np.abs(given), _MIN_DISTORTION), 0.0)
