"""Fixed-lag smoother of a rig of single cameras: a window is solved at each frameset, and its oldest keyframe leaves.

The oldest keyframe is marginalised together with the landmarks that it sees, which leaves a prior on the states that
have seen the same landmarks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.backend.states import RigState, StateCovariance, tilt_covariance
from graphvio.geometry import se3_adjoint, se3_inverse, se3_log
from graphvio.measurements.motion import LocatedPoints
from graphvio.measurements.window_views import FirstWindow, WindowViews
from graphvio.monocular.adjustment import Adjusted, Measurements, adjust, covariance_of, views_only
from graphvio.monocular.calibration import WindowCalibration, time_offset_s
from graphvio.monocular.held_landmarks import HeldLandmarks
from graphvio.monocular.knock import CONFIRMED, OverlapKnockDetector
from graphvio.monocular.marginalisation import first_window, with_landmarks, without_first
from graphvio.monocular.points import Solved, covariance_since, located_points
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.reversal import adjust_forwards, is_reversed
from graphvio.monocular.sample_buffer import SampleBuffer
from graphvio.monocular.sightings import far_off
from graphvio.monocular.states import States
from graphvio.monocular.structure import Structure
from graphvio.monocular.window import MAX_ERROR2, MAX_KEYFRAMES, MAX_OFF, KeyframeWindow
from graphvio.self_calibration.pixel_noise import pixel_noise

FIRST_MONOCULAR_SIGMA_PX = 0.3
_MAX_SIGMA_PX = 0.6
_NOISE_GAIN = 0.1  # share by which one keyframe corrects the estimated pixel noise
_STEPS, _KEYFRAME_STEPS, _RECALIBRATION_STEPS = 2, 3, 10
_CONVERGED = 0.1  # squared distance from the solution, in standard deviations; the next frameset goes on from there
_MAX_EXCESS_COST = 1.0  # by which landmarks in front may fit worse than behind: views alone cannot distinguish them
_MIN_LANDMARKS = 8  # landmarks that constrain the newest state
_MIN_FITTING = 0.3  # share of the landmarks
_POSE_AND_GRAVITY = np.r_[0:6, 9:12]
NO_COVARIANCE = StateCovariance(np.zeros((6, 6)))


class Solution(NamedTuple):
    """Result of solving the window at a frameset.

    Attributes:
        imu_errors2: squared whitened errors of the IMU between the states.
        is_tracking: whether enough landmarks constrain the newest state.
        dropped: index of the camera -> identities of tracks that do not stand still.
        is_possible: whether real sensors may have the estimated calibration.
        knocked: indices of the cameras whose places are estimated again from now on, after a knock.
    """

    imu_errors2: Float
    is_tracking: bool
    dropped: Mapping[int, Int]
    is_possible: bool
    knocked: frozenset[int]


class WindowSolver:
    """Solves the windows of a rig, one after the other.

    Args:
        cameras: cameras of the rig file.
        calibration: calibration of the rig, with what is known of it.
        samples: buffer of the IMU samples.

    Attributes:
        calibration: as above; it may be replaced, for the next window.
        samples: as above; likewise.
        covariance: covariance of the newest state.
        first_pose_ns: stamp of the window's first pose, 0 before the first window.
    """

    def __init__(self, cameras: Cameras, calibration: WindowCalibration, samples: SampleBuffer) -> None:
        self.calibration = calibration
        self.samples = samples
        self.covariance = NO_COVARIANCE
        self.first_pose_ns = 0
        self._first_time_offset_s = 0.0
        self._cameras = cameras
        self._sigma_px = FIRST_MONOCULAR_SIGMA_PX
        self._solved: Solved | None = None
        self._held: HeldLandmarks | None = None
        self._turns: list[Float] = []  # (6,) tangents of the epoch's changes of the frame, see `_moved`
        self._final: list[tuple[int, Float]] = []
        self._on_views: Callable[[WindowViews | FirstWindow], None] | None = None
        self._knocks = OverlapKnockDetector(cameras)

    # ------------------------------------------------------------------ what is known

    def covariance_since(self, then_ns: int) -> Float | None:
        """Return the covariance (6, 6) of the motion since a keyframe of the window, in the newest body frame."""
        return None if self._solved is None else covariance_since(self._solved, then_ns)

    def located_points(self) -> dict[int, LocatedPoints]:
        """Return the points that the newest state sees, by camera."""
        return {} if self._solved is None else located_points(self._solved)

    def take_final(self) -> list[tuple[int, Float]]:
        """Return stamps and poses ``nav_T_body`` of keyframes that left the window since the last call."""
        taken, self._final = self._final, []
        return taken

    def on_views(self, on_views: Callable[[WindowViews | FirstWindow], None]) -> None:
        """Register a function that gets the views of each landmark once, as it leaves the window or the window ends."""
        self._on_views = on_views

    def covariance_of_turns(self, odom_T_body: Float) -> Float:
        """Return the covariance (6, 6) of a pose (4, 4) by the steps that were taken out of the trajectory.

        Relative to the first pose, the trajectory is off by as much as its frame was turned where the rig file had
        proved wrong, or after a knock; the covariance of the state does not include this. The tangent is in body.
        """
        body_by_odom = se3_adjoint(se3_inverse(odom_T_body))
        turns = body_by_odom @ np.array(self._turns).reshape(-1, 6).T
        return np.asarray(turns @ turns.T)

    # ------------------------------------------------------------------ one window

    def begin(self, window: KeyframeWindow, stamp_ns: int) -> None:
        """Begin an epoch with its first window, at the frameset of its first pose."""
        self.first_pose_ns = stamp_ns
        self.calibration.begin(window.factors)
        self._first_time_offset_s = self.samples.time_offset_s

    def solve(self, window: KeyframeWindow, stamp_ns: int, is_keyframe: bool) -> Solution:
        """Solve for the states and landmarks, and leave out landmarks that do not stand still.

        Args:
            window: window with the newest state and the views from it.
            stamp_ns: stamp of the newest state.
            is_keyframe: whether the newest state is a keyframe, and stays.

        Raises:
            numpy.linalg.LinAlgError: if the measurements do not determine the states and landmarks.
        """
        calibration, held = self.calibration, self._held_landmarks(window, is_keyframe)
        adjusted, ids = self._adjusted(window, held, _KEYFRAME_STEPS if is_keyframe else _STEPS)
        if is_keyframe and held is not None:
            window.landmarks.put(held.ids, *held.moved_along(adjusted.states))
            adjusted, ids = self._adjusted(window, None, _KEYFRAME_STEPS)
        knocked: frozenset[int] = frozenset()
        if is_keyframe and calibration.update_factors(adjusted, window.prior):
            adjusted = self._recalibrated(window, adjusted, ids)
            self._knocks.forget()
        elif is_keyframe and calibration.size:
            difference = adjusted.states.calibration[: adjusted.states.n_camera_parameters]
            knocked = self._knocks.update(window.views[-1], difference, calibration.covariance_so_far)
            if knocked:
                adjusted, ids = self._after_knock(window, knocked)
        self.samples.time_offset_s = time_offset_s(adjusted.states.calibration)
        is_tracking, dropped = self._leave_out_moving(window, adjusted, ids)
        self._solved = Solved(adjusted, ids, window.views[-1])
        self.covariance = _newest_covariance(adjusted)
        is_possible = calibration.is_possible(adjusted.states.calibration)
        if is_keyframe:
            if is_possible:
                calibration.note(stamp_ns, adjusted.states, self.covariance)
            self._finish_keyframe(window, adjusted)
            self._held = None
        return Solution(adjusted.equations.imu_errors2, is_tracking, dropped, is_possible, knocked)

    def end(self, window: KeyframeWindow) -> None:
        """Declare all poses of the window final, and hand over the views of its landmarks."""
        if self._on_views is not None:
            while window.states.stamps_ns[0] < self.first_pose_ns:
                self._forget_first(window)
        states = window.states
        if self._on_views is not None:
            structure, places, _ = self._structure(window)
            self._hand_over(structure, states, places)
        self._final += [(int(ns), pose) for ns, pose in zip(states.stamps_ns, states.poses, strict=True)]

    def discard(self) -> None:
        """Discard what the epoch's windows have shown of the calibration: no calibration explains them."""
        self.calibration.discard()
        self.samples.time_offset_s = self._first_time_offset_s

    def forget(self) -> None:
        """Forget the last solution, with the covariance of its newest state."""
        self._solved, self._held, self.covariance, self._turns = None, None, NO_COVARIANCE, []
        self._knocks.forget()

    # ------------------------------------------------------------------ parts of these steps

    def _adjusted(self, window: KeyframeWindow, held: HeldLandmarks | None, max_steps: int) -> tuple[Adjusted, Int]:
        """Adjust a window by all landmarks but the held ones; return also the identities (L,) of those used."""
        structure, places, ids = self._structure(window)
        prior = window.prior
        if held is not None:
            prior, others = held.prior, ~np.isin(ids, held.ids)
            structure, places, ids = structure.of(others), places[others], ids[others]
        measured = self._measured(window, structure)
        adjusted = adjust(measured, window.states, places, prior, max_steps, self.calibration.file(), _CONVERGED)
        is_seen = np.isin(ids, window.views[-1].landmark)
        if is_reversed(adjusted, is_seen):
            with suppress(np.linalg.LinAlgError):
                forwards = adjust_forwards(measured, window.states, places, prior, self.calibration.file(), _CONVERGED)
                is_likelier = forwards.equations.cost < adjusted.equations.cost + _MAX_EXCESS_COST
                if is_likelier and not is_reversed(forwards, is_seen):
                    adjusted = forwards
        _put(adjusted, window, ids)
        return adjusted, ids

    def _recalibrated(self, window: KeyframeWindow, before: Adjusted, ids: Int) -> Adjusted:
        """Adjust a window with other factors of the rig file, and let the path of the cameras continue.

        With another calibration the window's past is another one, too. The window is expressed in the frame in which
        the first camera is at the newest state where it was, so that the trajectory has no step. Body turns there by as
        much as its attitude relative to the camera is corrected.
        """
        file = self.calibration.file()
        after = adjust(
            before.measured, before.states, before.landmarks, window.prior, _RECALIBRATION_STEPS, file, _CONVERGED
        )
        _put(after, window, ids)
        then, now = (
            each.states.poses[-1] @ each.states.cameras(self._cameras).body_T_cam[0] for each in (before, after)
        )
        return self._moved(window, after, then @ se3_inverse(now))

    def _moved(self, window: KeyframeWindow, adjusted: Adjusted, new_T_odom: Float) -> Adjusted:
        """Express an adjusted window in another frame, given by ``new_T_odom`` (4, 4), and linearise it there."""
        self._turns.append(se3_log(new_T_odom))
        window.turn(new_T_odom)
        structure, places, _ = self._structure(window)
        measured, file = adjusted.measured._replace(structure=structure), self.calibration.file()
        return adjust(measured, window.states, places, window.prior, 0, file)

    def _after_knock(self, window: KeyframeWindow, knocked: frozenset[int]) -> tuple[Adjusted, Int]:
        """Adjust a window without the knocked cameras' views from before the knock, and with their places unknown.

        The window is expressed in the frame in which the last keyframe before the knock is where it was.
        """
        self._knocks.forget()
        last = len(window.views) - CONFIRMED - 1
        then = window.states.poses[last]
        before, since = window.views[: last + 1], window.views[last + 1 :]
        window.views = [views.without_cameras(knocked) for views in before] + since
        change = self.calibration.release_places(knocked)
        window.prior = None if window.prior is None else window.prior.after_change(change)
        adjusted, ids = self._adjusted(window, None, _RECALIBRATION_STEPS)
        return self._moved(window, adjusted, then @ se3_inverse(adjusted.states.poses[last])), ids

    def _structure(self, window: KeyframeWindow) -> tuple[Structure, Float, Int]:
        """Return the window's landmarks, where they are (L, 3), and their identities (L,)."""
        states = window.states
        return window.landmarks.structure(window.views, states.poses, states.cameras(self._cameras))

    def _measured(self, window: KeyframeWindow, structure: Structure) -> Measurements:
        samples = self.samples.between(window.states.stamps_ns, self.calibration.is_file_exact)
        return Measurements(self._cameras, structure, self._sigma_px, samples, np.flatnonzero(window.stationary))

    def _held_landmarks(self, window: KeyframeWindow, is_keyframe: bool) -> HeldLandmarks | None:
        """Return the landmarks that are held since the newest keyframe, or None where they have to be solved for.

        They are linearised at the first frameset after the keyframe, unless that frameset is a keyframe, too.
        """
        if self._held is None and not is_keyframe:
            self._held = self._hold(window.without_newest())
        return self._held if self._held is not None and self._held.holds(window) else None

    def _hold(self, window: KeyframeWindow) -> HeldLandmarks:
        """Linearise the views of those landmarks of a keyframe's window that the keyframe does not see."""
        structure, places, ids = self._structure(window)
        held = ~np.isin(ids, window.views[-1].landmark)
        ids, places, measured = ids[held], places[held], self._measured(window, structure.of(held))
        calibrates = self.calibration.file() is not None
        prior, eliminated = with_landmarks(measured, window.states, places, window.prior, calibrates)
        return HeldLandmarks(ids, measured, places, prior, eliminated)

    def _leave_out_moving(self, window: KeyframeWindow, adjusted: Adjusted, ids: Int) -> tuple[bool, Mapping[int, Int]]:
        """End landmarks that do not stand still.

        Returns:
            Whether enough other landmarks are seen, and the tracks of the ended ones: index of the camera ->
            identities.
        """
        structure, errors2 = adjusted.measured.structure, adjusted.equations.errors2
        off = far_off(structure, errors2, MAX_ERROR2, MAX_OFF)
        seen = np.isin(ids, window.views[-1].landmark)
        is_tracking = int((seen & ~off).sum()) >= max(_MIN_LANDMARKS, _MIN_FITTING * int(seen.sum()))
        dropped = window.landmark_ids.tracks_of(ids[off])
        window.landmark_ids.end(ids[off])
        window.views = [views.without(ids[off]) for views in window.views]
        if is_tracking:
            _leave_out_mismatches(window, structure, ids, errors2)
        return is_tracking, dropped

    def _finish_keyframe(self, window: KeyframeWindow, adjusted: Adjusted) -> None:
        """Let the oldest keyframe leave where the window is full, and update the estimate of the pixel noise."""
        window.landmark_ids.note_keyframe()
        if len(adjusted.equations.errors2):
            wanted = min(pixel_noise(adjusted.equations.errors2, self._sigma_px), _MAX_SIGMA_PX)
            self._sigma_px += _NOISE_GAIN * (wanted - self._sigma_px)
        while len(window.states.poses) > MAX_KEYFRAMES:
            self._forget_first(window)

    def _forget_first(self, window: KeyframeWindow) -> None:
        """Marginalise the oldest state and the landmarks that it sees."""
        states = window.states
        structure, places, ids = self._structure(window)
        leaving = np.isin(ids, window.views[0].landmark)
        measured = self._measured(window, structure.of(leaving))
        is_before = int(states.stamps_ns[0]) < self.first_pose_ns
        if not is_before:
            self._hand_over(measured.structure, states, places[leaving])
        walk = self.calibration.walk((states.stamps_ns[1] - states.stamps_ns[0]) * 1e-9)
        window.prior = without_first(measured, states, places[leaving], window.prior, walk)
        window.landmark_ids.end(window.views[0].landmark)
        window.views = [views.without(window.views[0].landmark) for views in window.views[1:]]
        del window.stationary[0]
        self._final.append((int(states.stamps_ns[0]), states.poses[0]))
        window.states = states.of(np.arange(1, len(states.poses)))
        if is_before and window.states.stamps_ns[0] >= self.first_pose_ns and self._on_views is not None:
            self._on_views(first_window(window.prior))

    def _hand_over(self, structure: Structure, states: States, places: Float) -> None:
        """Hand over the views of some landmarks (L, 3), which no later window will use."""
        if self._on_views is None or not len(places):
            return
        information, gradient = views_only(states.cameras(self._cameras), structure, self._sigma_px, states, places)
        kept = np.isin(np.arange(len(states.poses)), structure.state)
        rows = np.repeat(kept, 6)
        self._on_views(
            WindowViews(states.stamps_ns[kept], states.poses[kept], information[np.ix_(rows, rows)], gradient[rows])
        )


def _put(adjusted: Adjusted, window: KeyframeWindow, ids: Int) -> None:
    """Put adjusted states, and landmarks by their identities (L,), into a window."""
    window.states = adjusted.states
    window.landmarks.put(ids, adjusted.measured.structure.odom_T_landmark, adjusted.landmarks)


def newest_state(states: States) -> RigState:
    """Return the newest of a window's states."""
    return RigState(states.poses[-1], states.velocities[-1], states.biases[:3], states.biases[3:], states.gravity)


def _newest_covariance(adjusted: Adjusted) -> StateCovariance:
    """Return the covariance of the newest state."""
    n = len(adjusted.states.poses)
    pose, velocity, common = 6 * (n - 1) + np.arange(6), 9 * n - 3 + np.arange(3), 9 * n + np.arange(9)
    joint = covariance_of(adjusted.equations.hessian, np.concatenate([pose, velocity, common]))
    return StateCovariance(
        pose=joint[:6, :6],
        velocity=joint[6:9, 6:9],
        gravity=joint[9:12, 9:12],
        gyro_bias=joint[12:15, 12:15],
        accel_bias=joint[15:, 15:],
        tilt=tilt_covariance(newest_state(adjusted.states), joint[np.ix_(_POSE_AND_GRAVITY, _POSE_AND_GRAVITY)]),
    )


def _leave_out_mismatches(window: KeyframeWindow, structure: Structure, ids: Int, errors2: Float) -> None:
    """Leave out newest views of adopted tracks that do not fit their landmark; these tracks begin one of their own."""
    rows = np.flatnonzero((structure.state == len(window.views) - 1) & (errors2 > MAX_ERROR2))
    if not len(rows):
        return
    landmarks = ids[np.searchsorted(structure.rows, rows, side="right") - 1]
    newest = window.views[-1]
    window.views[-1] = kept = newest.without_adopted(landmarks, structure.camera[rows])
    window.landmark_ids.end(np.setdiff1d(newest.landmark, kept.landmark))
