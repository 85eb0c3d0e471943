"""Initialisation of single cameras: scale, gravity, velocity and biases of a first window, in any motion.

Until the scale is known there is no estimate: keyframes are collected, and with each new one a window is solved, first
in closed form, then by nonlinear adjustment. It is accepted once its covariance shows that the scale is known, and its
residuals are no larger than noise explains.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.initialisation import level
from graphvio.errors import MeasurementError
from graphvio.geometry import se3, se3_inverse
from graphvio.measurements.motion import CameraTracks
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.monocular.adjustment import Adjusted, Measurements, adjust, evidence_of, scale_sigma
from graphvio.monocular.calibration import WindowCalibration
from graphvio.monocular.closed_form import first_guess
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.sample_buffer import MAX_TIME_OFFSET_NS
from graphvio.monocular.sightings import LandmarkIds, Landmarks, Views, far_off
from graphvio.monocular.states import States, size_m
from graphvio.monocular.structure import PRIOR_INFORMATION, located
from graphvio.monocular.window import MAX_ERROR2, MAX_KEYFRAMES, MAX_OFF, KeyframeWindow
from graphvio.monocular.window_prior import Prior, first_prior
from graphvio.self_calibration.evidence import Gaussian
from graphvio.self_calibration.inertial import InertialSamples

MAX_SCALE_SIGMA = 0.05
_MIN_KEYFRAMES, _MIN_METRIC_KEYFRAMES = 8, 5  # the latter where overlapping views give the scale
_MIN_DURATION_S, _MIN_METRIC_DURATION_S = 1.0, 0.5
MAX_DURATION_NS = 5_000_000_000
_MIN_LANDMARKS = 20
_MIN_FITTING = 0.7  # share of the landmarks
_MAX_IMU_ERROR2 = 60.0  # squared whitened error of an interval, of 9 dimensions
_MAX_GRAVITY_EXCESS = 0.1  # m/s^2
_STEPS = 40
ACCEL_BIAS_SIGMA = 0.15
_MAX_SIGMAS = 5.0
_ROUGH, _ROUGH_STEPS = 10.0, 15  # factor on the noise, and steps, of a first adjustment with a wrong rig file
_FIRST_DOUBT = 3  # windows that fit no motion with an exact rig file, before the file is doubted
_OTHER_SCALES = (0.6, 1.7)
_MIN_WORSE = 12.5  # excess cost that excludes another scale: it is five standard deviations off
POSE_SIGMAS = np.full(6, 1e-3)  # of the first pose, which defines nav


class _Keyframe(NamedTuple):
    stamp_ns: int
    camera_tracks: Mapping[int, CameraTracks]
    is_stationary: bool


class Initialiser:
    """Collects keyframes until their scale is known.

    Args:
        cameras: cameras of the rig.
        calibration: how wrong the rig file may be.
        samples_of: function that returns the IMU samples for keyframes' stamps (K,); its second argument says whether
            the time offset is known.
        sigma_px: noise of a corner's position.
        doubts_file: whether windows that fit no motion are solved again with a rig file that is taken to be wrong.
    """

    def __init__(
        self,
        cameras: Cameras,
        calibration: WindowCalibration,
        samples_of: Callable[[np.ndarray, bool], InertialSamples],
        sigma_px: float,
        doubts_file: bool = True,
    ) -> None:
        self._cameras = cameras
        self._calibration = calibration
        self._samples_of = samples_of
        self._sigma_px = sigma_px
        self._doubts_file = doubts_file
        self._gyro_bias, self._gyro_bias_sigma = np.zeros(3), 0.1
        self._keyframes: list[_Keyframe] = []
        self._fits_no_motion = False  # whether the window that was tested last fits no motion
        self._is_file_doubted, self._keyframes_in_doubt = False, 0  # since a window that fits contradicted it
        self._contradicted, self._doubted_at = 0, _FIRST_DOUBT  # windows without a motion, and how many raise a doubt
        self.reason = "no image has come"
        self.scale_sigma = np.inf  # sigma of the scale of the window that was tested last, as a share

    def set_gyro_bias_prior(self, gyro_bias: Float, sigma: float) -> None:
        """Set the prior of the gyro's bias, (3,) rad/s as measured at a standstill, and its standard deviation."""
        self._gyro_bias, self._gyro_bias_sigma = gyro_bias, sigma

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the first keyframe, or None."""
        return self._keyframes[0].stamp_ns if self._keyframes else None

    def add(
        self, stamp_ns: int, camera_tracks: Mapping[int, CameraTracks], is_stationary: bool
    ) -> KeyframeWindow | None:
        """Add a keyframe, and return the window if its scale is known; otherwise `reason` says why it is not."""
        if is_stationary and self._keyframes and self._keyframes[-1].is_stationary:
            self._keyframes.pop()  # of a standstill only the newest keyframe is kept
        self._keyframes.append(_Keyframe(stamp_ns, camera_tracks, is_stationary))
        del self._keyframes[:-MAX_KEYFRAMES]
        while stamp_ns - self._keyframes[0].stamp_ns > MAX_DURATION_NS:
            del self._keyframes[0]
        duration_s = (stamp_ns - self._keyframes[0].stamp_ns) * 1e-9
        is_metric = shared_points(camera_tracks) >= _MIN_LANDMARKS
        min_keyframes = _MIN_METRIC_KEYFRAMES if is_metric else _MIN_KEYFRAMES
        min_duration_s = _MIN_METRIC_DURATION_S if is_metric else _MIN_DURATION_S
        if is_stationary or len(self._keyframes) < min_keyframes or duration_s < min_duration_s:
            self.reason = "the images show too little motion"
            return None
        for factors in self._next_candidates():
            try:
                window = self._solved(factors)
            except (np.linalg.LinAlgError, MeasurementError) as error:
                self.reason = str(error)
                return None
            if window is not None or not self._fits_no_motion:
                return window
        return None

    def _next_candidates(self) -> list[Float]:
        """Return the factors (G,) by which the rig file may be wrong, the likeliest first, and count the attempt."""
        if self._is_file_doubted:  # every other keyframe: each attempt takes as long as many framesets
            self._keyframes_in_doubt += 1
            return self._calibration.candidates[1:] if self._keyframes_in_doubt % 2 else []
        self._contradicted += self._fits_no_motion
        if not (self._doubts_file and self._fits_no_motion) or self._contradicted < self._doubted_at:
            return self._calibration.candidates[:1]
        self._doubted_at *= 2
        self._calibration.forget()
        return self._calibration.candidates

    def _solved(self, factors: Float) -> KeyframeWindow | None:
        """Solve for a window of all keyframes with a rig file that is wrong by factors (G,); None if it is rejected."""
        self._fits_no_motion = False
        file = self._calibration.file(factors)
        keyframes, samples = self._covered_keyframes(file)
        landmark_ids = LandmarkIds(len(self._cameras.focal_px), MAX_KEYFRAMES - 1)
        views = []
        for keyframe in keyframes:
            views.append(landmark_ids.join(keyframe.camera_tracks))
            landmark_ids.note_keyframe()
        states = self._first_states(samples, views, file)
        if states is None:
            return None
        bias_sigmas = np.repeat([self._gyro_bias_sigma, ACCEL_BIAS_SIGMA], 3)
        prior = first_prior(states, bias_sigmas, np.concatenate([self._gyro_bias, np.zeros(3)]), POSE_SIGMAS)
        stationary = np.flatnonzero([keyframe.is_stationary for keyframe in keyframes])
        landmarks = Landmarks()
        fitting = 1.0
        for is_first in (True, False):
            cameras = states.cameras(self._cameras)
            structure, places, ids = landmarks.structure(views, states.poses, cameras)
            if len(ids) < _MIN_LANDMARKS:
                self.reason = f"only {len(ids)} points stand still"
                self._fits_no_motion = True
                return None
            places = located(
                states.poses, states.falls, cameras, places, structure, self._sigma_px, PRIOR_INFORMATION, True
            )
            measured = Measurements(self._cameras, structure, self._sigma_px, samples, stationary)
            if file is not None and is_first:
                measured, states, places = self._roughly_adjusted(measured, states, places, prior, file)
            adjusted = adjust(measured, states, places, prior, _STEPS, file)
            states = adjusted.states
            landmarks.put(ids, adjusted.measured.structure.odom_T_landmark, adjusted.landmarks)
            off = far_off(structure, adjusted.equations.errors2, MAX_ERROR2, MAX_OFF)
            if file is not None and is_first:
                factors = self._calibration.likeliest_factors(evidence_of(adjusted.equations, states, file))
                file = self._calibration.file(factors)
            fitting *= 1.0 - float(off.mean())
            landmark_ids.end(ids[off])
            views = [each.without(ids[off]) for each in views]
        self.reason = self._fault(adjusted, fitting, factors) or _ambiguity(adjusted, prior, file)
        if self.reason:
            return None
        if file is None and self._doubts_file and self._calibration.is_contradicted(adjusted, prior):
            self._fits_no_motion = self._is_file_doubted = True
            self.reason = "images and IMU contradict the rig file"
            return None
        still = [keyframe.is_stationary for keyframe in keyframes]
        return self._in_nav(KeyframeWindow(states, views, still, landmark_ids, landmarks, prior, factors))

    def _covered_keyframes(self, file: Gaussian | None) -> tuple[list[_Keyframe], InertialSamples]:
        """Return the keyframes that the IMU covers for any possible time offset, and the IMU samples."""
        keyframes = self._keyframes
        samples = self._samples_of(np.array([keyframe.stamp_ns for keyframe in keyframes]), file is None)
        if file is not None:  # else samples that begin late would exclude some time offsets
            since_ns = samples.stamps_ns[0] + MAX_TIME_OFFSET_NS
            keyframes = [keyframe for keyframe in keyframes if keyframe.stamp_ns >= since_ns]
        return keyframes, samples._replace(keyframes_ns=np.array([keyframe.stamp_ns for keyframe in keyframes]))

    def _first_states(self, samples: InertialSamples, views: Sequence[Views], file: Gaussian | None) -> States | None:
        """Guess the states of the keyframes in closed form, or return None where too few points stay in view."""
        poses = np.tile(np.eye(4), (len(views), 1, 1))
        structure, _, ids = Landmarks().structure(views, poses, self._cameras)
        if len(ids) < _MIN_LANDMARKS:
            self.reason = f"only {len(ids)} points stay in view"
            return None
        guess = first_guess(samples, structure, self._cameras, self._gyro_bias)
        biases = np.concatenate([guess.gyro_bias, np.zeros(3)])
        calibration = np.zeros(self._calibration.size) if file is None else file.mean
        return States(samples.keyframes_ns, guess.poses, guess.velocities, guess.gravity, biases, calibration)

    def _roughly_adjusted(
        self, measured: Measurements, states: States, places: Float, prior: Prior, file: Gaussian
    ) -> tuple[Measurements, States, Float]:
        """Adjust with a larger pixel noise: by a wrong rig file, residuals of several pixels are no mismatches yet."""
        rough = adjust(measured._replace(sigma_px=_ROUGH * self._sigma_px), states, places, prior, _ROUGH_STEPS, file)
        return measured._replace(structure=rough.measured.structure), rough.states, rough.landmarks

    def _fault(self, adjusted: Adjusted, fitting: float, factors: Float) -> str:
        """Return why a window is not accepted, or an empty string.

        IMU errors may be larger by the largest of the factors (G,): a rig file that is wrong understates the noise,
        too.
        """
        wrong_by = float(np.max(factors, initial=1.0))
        states, at = adjusted.states, adjusted.equations
        self._fits_no_motion = True
        if fitting < _MIN_FITTING:
            return f"only {100 * fitting:.0f} % of the points fit one motion"
        if not (at.imu_errors2 < wrong_by**2 * _MAX_IMU_ERROR2).all():
            return "images and IMU contradict each other"
        if abs(float(np.linalg.norm(states.gravity)) - GRAVITY_M_S2) > _MAX_GRAVITY_EXCESS:
            return "images and IMU contradict each other about gravity"
        if states.calibration.any() and not self._is_plausible(states):
            return "images and IMU contradict each other, whatever the calibration"
        self._fits_no_motion = False
        self.scale_sigma = sigma = scale_sigma(states, at.hessian)
        if not sigma < MAX_SCALE_SIGMA:
            return f"the scale is known to {100 * sigma:.0f} % only"
        return ""

    def _is_plausible(self, states: States) -> bool:
        """Return whether calibration and biases are within the range of real sensors."""
        of_accel = np.abs(states.biases[3:]) <= _MAX_SIGMAS * ACCEL_BIAS_SIGMA
        return bool(of_accel.all()) and self._calibration.is_plausible(states.calibration)

    def _in_nav(self, window: KeyframeWindow) -> KeyframeWindow:
        """Express a window in nav: level, with its first pose at the origin and with heading zero."""
        states = window.states
        body_T_odom = se3_inverse(states.poses[0])
        nav_T_odom = se3(level(-body_T_odom[:3, :3] @ states.gravity), np.zeros(3)) @ body_T_odom
        window.landmarks.turn(nav_T_odom)
        assert window.prior is not None
        turned = states.turned(nav_T_odom)
        known = window.prior.at
        at = replace(turned.of(np.arange(1)), biases=known.biases)
        return replace(window, states=turned, prior=window.prior._replace(at=at))


def shared_points(camera_tracks: Mapping[int, CameraTracks]) -> int:
    """Count the points that two cameras see."""
    return sum(len(seen.rows) for tracks in camera_tracks.values() for seen in tracks.matches)


def _ambiguity(adjusted: Adjusted, prior: Prior, file: Gaussian | None) -> str:
    """Return a message if another scale fits as well as the one that was found, or an empty string.

    A covariance describes one minimum only and shows no others: the window is adjusted again from other scales.
    """
    states, cost, structure = adjusted.states, adjusted.equations.cost, adjusted.measured.structure
    for factor in _OTHER_SCALES:
        scaled = states.poses.copy()
        scaled[:, :3, 3] *= factor
        frames = structure.odom_T_landmark.copy()
        frames[:, :3, 3] *= factor
        other = adjusted.measured._replace(structure=structure._replace(odom_T_landmark=frames))
        start = replace(states, poses=scaled, velocities=factor * states.velocities)
        found = adjust(other, start, adjusted.landmarks * np.array([1.0, 1.0, 1.0 / factor]), prior, _STEPS, file)
        apart = abs(size_m(found.states.poses[:, :3, 3]) / size_m(states.poses[:, :3, 3]) - 1.0)
        if apart > MAX_SCALE_SIGMA and found.equations.cost < cost + _MIN_WORSE:
            return f"scales {100 * apart:.0f} % apart fit as well as each other"
    return ""
