"""Velocities of body by which rolling shutters are compensated, measured by vision, and the effect of their errors.

The compensation of a frameset needs the velocity at its stamp. Where no state estimator knows it, it is computed from
the measured motions, and the frameset's motion is measured again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.frontend.depth.tracks import TrackedFrame, common_rows
from graphvio.frontend.motion.observations import RigArrays, correspond
from graphvio.frontend.motion.readout_errors import derivatives_by_readout
from graphvio.frontend.pairs.agreement import SharedErrors
from graphvio.frontend.references import References
from graphvio.frontend.tracking.measured_readouts import MeasuredReadouts
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion, as_at_stamp
from graphvio.frontend.tracking.tracker import GroupTracker
from graphvio.frontend.tracking_frontend import TrackedFrameset
from graphvio.geometry import se3_inverse
from graphvio.measurements.motion import ByVelocities
from graphvio.rig import Rig

_UNKNOWN_SIGMA_M_S = 0.5
_UNKNOWN_SIGMA_RAD_S = 0.2
_MIN_Z = 1e-3


class Readouts:
    """Keeps the motions of body by which rolling shutters are compensated: of the newest frameset and the references.

    Args:
        rig: the rig, with rolling-shutter cameras.
    """

    def __init__(self, rig: Rig) -> None:
        self._line_s = [1e-6 * group.left.line_time_us for group in rig.groups]
        readout_ns = max(camera.readout_ns for camera in rig.cameras)
        self._gyro_sigma = 0.0 if rig.imu is None else rig.imu.gyro_noise_density / float(np.sqrt(1e-9 * readout_ns))
        self._measured = MeasuredReadouts(readout_ns)
        self._applied: dict[int, ReadoutMotion] = {}  # by stamp

    def keep(self, seen: TrackedFrameset, references: References) -> None:
        """Store the readout motion of a frameset, which may become a reference; drop those that no reference needs."""
        self._applied = {ns: each for ns, each in self._applied.items() if ns in references.stamps_ns}
        if seen.readout is not None:
            self._applied[seen.stamp_ns] = seen.readout

    def note(self, seen: TrackedFrameset, cur_T_ref: Float) -> None:
        """Add the measured motion ``cur_T_ref`` (4, 4) of a frameset, from which velocities are computed."""
        now, then = seen.readout, self._applied.get(seen.reference_stamp_ns)
        by_imu = _by_imu(now), _by_imu(then)
        self._measured.note(seen.reference_stamp_ns, seen.stamp_ns, se3_inverse(cur_T_ref), by_imu)

    def compensated_by_motion(
        self, seen: TrackedFrameset, trackers: list[GroupTracker], references: References, rig: Rig
    ) -> TrackedFrameset | None:
        """Compensate a frameset and its reference again, by velocities computed from measured motions.

        Args:
            seen: the tracks of the frameset.
            trackers: the trackers of all groups; their newest frames are changed.
            references: the reference frames; those of the frameset's reference are changed.
            rig: the rig, with the calibration that is in force.

        Returns:
            The frameset, compensated again, or None where both velocities are known already, or cannot be computed.
        """
        if is_velocity_known(seen.readout) and is_velocity_known(self._applied.get(seen.reference_stamp_ns)):
            return None
        now, then = self._measured.at(seen.stamp_ns), self._measured.at(seen.reference_stamp_ns)
        if now is None or then is None:
            return None
        frames = {j: trackers[j].read_out(now) for j in seen.frames}
        references.read_out(seen.reference_stamp_ns, then, rig)
        self._applied[seen.reference_stamp_ns] = then
        reference = references.shared(frames)
        for j, keyframe in reference.items():
            trackers[j].read_out_keyframe(keyframe, then)
        return TrackedFrameset(seen.stamp_ns, seen.frozen, frames, reference, correspond(reference, frames), now)

    def compensated_by_both_sides(
        self, stamp_ns: int, frames: Mapping[int, TrackedFrame], rig: Rig
    ) -> dict[int, TrackedFrame] | None:
        """Compensate an earlier frameset again, by velocities computed from framesets before and after it.

        Args:
            stamp_ns: stamp of the frameset.
            frames: its tracks, by the index of the pair or single camera.
            rig: the rig, with the calibration that is in force.

        Returns:
            The tracks, compensated again, or None while there is no later frameset.
        """
        readout = self._measured.at(stamp_ns) if self._measured.knows_both_sides_of(stamp_ns) else None
        if readout is None:
            return None
        return {
            j: as_at_stamp(frame, rig.groups[j], readout) if self._line_s[j] else frame for j, frame in frames.items()
        }

    def with_unknown_depths(self, seen: TrackedFrameset, arrays: RigArrays, cur_T_ref: Float) -> TrackedFrameset:
        """Add the effect of unknown depths on the compensation to the covariances of single cameras' points.

        While the depth of a point is unknown, its rays at both stamps are compensated with a wrong one.

        Args:
            seen: the tracks of the frameset.
            arrays: the calibration of the rig.
            cur_T_ref: (4, 4) predicted motion of body since the reference.
        """
        joined = seen.correspondences
        covariances = joined.observations.covariances.copy()
        for j in joined.singles:
            frame, reference, rows = seen.frames[j], seen.reference[j], joined.rows[j]
            then = np.searchsorted(reference.ids, frame.ids[rows])
            of_pair = joined.observations.pair == j
            slopes = _slopes_of_both(
                joined.observations.points[of_pair],
                reference.shutter_slopes[then],
                frame.shutter_slopes[rows],
                arrays.cam_T_body[j, 0] @ cur_T_ref @ arrays.body_T_left[j],
            )
            by_depth = np.tile(np.eye(3), (len(rows), 1, 1))
            by_depth[:, :2, 2] = slopes
            covariances[of_pair] = by_depth @ covariances[of_pair] @ by_depth.transpose(0, 2, 1)
        observations = joined.observations._replace(covariances=covariances)
        return seen._replace(correspondences=replace(joined, observations=observations))

    def errors(
        self, seen: TrackedFrameset, arrays: RigArrays, inlier: Bool, cur_T_ref: Float, noise_px: float
    ) -> tuple[ByVelocities, Float]:
        """Return how a motion depends on the velocities of the readouts, and its covariances by angular velocities.

        Args:
            seen: the tracks of the frameset.
            arrays: the calibration of the rig.
            inlier: (N,) the points that the motion explains.
            cur_T_ref: (4, 4) the motion of body.
            noise_px: standard deviation of the pixel noise.

        Returns:
            The derivatives with respect to the velocities, and the velocities with their covariances; and the
            covariances (2, 6, 6) of the motion by errors of the angular velocities now and at the reference.
        """
        seconds, observations = self._line_seconds(seen), seen.correspondences.observations
        derivatives = derivatives_by_readout(arrays, observations, inlier, cur_T_ref, noise_px, seconds)
        used, covariances, rate_sigmas = self._velocities(seen)
        by_rates = rate_sigmas[:, None, None] * derivatives[:, :, :3]
        return ByVelocities(used, derivatives[:, :, 3:], covariances), by_rates @ by_rates.transpose(0, 2, 1)

    def shared_errors(self, seen: TrackedFrameset, arrays: RigArrays, noise_px: float) -> SharedErrors:
        """Return the function that computes a pair's derivatives with respect to the errors of the readouts.

        These errors are common to all pairs.

        Args:
            seen: the tracks of the frameset.
            arrays: the calibration of the rig.
            noise_px: standard deviation of the pixel noise.
        """
        seconds, observations, roots = self._line_seconds(seen), seen.correspondences.observations, self._roots(seen)

        def of_pair(pair: int, inlier: Bool, cur_T_ref: Float) -> Float:
            own, rows = observations.of_pair(pair), observations.pair == pair
            of_rows = np.ascontiguousarray(seconds[:, rows])
            return np.hstack(list(derivatives_by_readout(arrays, own, inlier, cur_T_ref, noise_px, of_rows) @ roots))

        return of_pair

    def _roots(self, seen: TrackedFrameset) -> Float:
        """Return square roots (2, 6, 6) of the covariances of ``[angular velocity, velocity]``, now and then."""
        _, covariances, rate_sigmas = self._velocities(seen)
        variances, axes = np.linalg.eigh(covariances)
        roots = np.zeros((2, 6, 6))
        roots[:, :3, :3] = rate_sigmas[:, None, None] * np.eye(3)
        roots[:, 3:, 3:] = axes * np.sqrt(np.maximum(variances, 0.0))[:, None]
        return roots

    def _velocities(self, seen: TrackedFrameset) -> tuple[Float, Float, Float]:
        """Return the velocities (2, 3) of the readouts now and at the reference, and how uncertain they are.

        Returns:
            The velocities, their covariances (2, 3, 3), and the standard deviations (2,) of the angular velocities: of
            their means over the readout by the noise of the gyro, or those of vision.
        """
        readouts = seen.readout, self._applied.get(seen.reference_stamp_ns)
        used, covariances = np.zeros((2, 3)), np.tile(_UNKNOWN_SIGMA_M_S**2 * np.eye(3), (2, 1, 1))
        rate_sigmas = np.full(2, _UNKNOWN_SIGMA_RAD_S)
        for k, readout in enumerate(readouts):
            if readout is None:
                continue
            used[k] = readout.velocity
            if readout.velocity_covariance is not None:
                covariances[k], rate_sigmas[k] = readout.velocity_covariance, readout.angular_velocity_sigma
            if readout.is_by_imu:
                rate_sigmas[k] = self._gyro_sigma
        return used, covariances, rate_sigmas

    def _line_seconds(self, seen: TrackedFrameset) -> Float:
        """Return the seconds (2, N) from the stamp until each point's line was exposed, now and at the reference."""
        parts = []
        for j, rows in sorted(seen.correspondences.rows.items()):
            frame, reference = seen.frames[j], seen.reference[j]
            then = np.searchsorted(reference.ids, frame.ids[rows])
            parts.append(self._line_s[j] * np.array([frame.pixels[rows, 1], reference.pixels[then, 1]]))
        return np.ascontiguousarray(np.hstack(parts))


def _slopes_of_both(points: Float, then: Float, now: Float, cur_T_ref: Float) -> Float:
    """Return by how much the rays of both framesets move against each other with the inverse depth, at the reference.

    Args:
        points: (N, 3) ``[x, y, 1/Z]`` at the reference.
        then: (N, 2) derivatives of the rays at the reference with respect to the inverse depth then.
        now: (N, 2) the same of the newest rays.
        cur_T_ref: (4, 4) predicted motion of points in the camera.
    """
    turned = np.column_stack([points[:, :2], np.ones(len(points))]) @ cur_T_ref[:3, :3].T
    turned += points[:, 2:] * cur_T_ref[:3, 3]
    z = np.maximum(turned[:, 2:], _MIN_Z)
    by_ray = (cur_T_ref[:2, :2] - (turned[:, :2] / z)[:, :, None] * cur_T_ref[2, :2]) / z[:, :, None]
    return np.asarray(then - np.linalg.solve(by_ray, (now / z)[:, :, None])[:, :, 0])


def readout_sigma_px(frame: TrackedFrame, reference: TrackedFrame | None, focal_px: float) -> Float:
    """Return the error (N,) of the compensation by unknown depths, pixels, for a pixel noise of 1 px.

    Args:
        frame: the tracks of a single camera with a rolling shutter.
        reference: its reference frame, which has the covariances of the depths, or None.
        focal_px: focal length, pixels per normalised image unit.

    Returns:
        Standard deviations (N,), infinite for tracks that the reference does not have.
    """
    sigma_px = np.full(len(frame.ids), np.inf)
    if reference is not None:
        now, then = common_rows(frame.ids, reference.ids)
        slopes_px = focal_px * np.linalg.norm(frame.shutter_slopes[now], axis=1)
        sigma_px[now] = slopes_px * np.sqrt(reference.covariances[then, 2, 2])
    return sigma_px


def is_velocity_known(readout: ReadoutMotion | None) -> bool:
    """Return whether the velocity by which rolling shutters are compensated is known, and not only a guess."""
    return readout is not None and readout.velocity_covariance is not None


def _by_imu(readout: ReadoutMotion | None) -> ReadoutMotion | None:
    return readout if readout is not None and readout.is_by_imu else None
