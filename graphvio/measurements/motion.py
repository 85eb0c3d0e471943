"""Relative motions, and the front-end's result for a frameset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float, Int


class Quality(StrEnum):
    """Quality of a measured motion: how far it can be trusted."""

    GOOD = "good"
    """Its covariance is consistent."""
    WEAK = "weak"
    """It is doubtful, for the reason that is given; its covariance is enlarged."""
    FAILED = "failed"
    """There is no motion."""


@dataclass(frozen=True, slots=True, eq=False)
class PairReport:
    """The contribution of one stereo pair to a frameset's motion.

    Attributes:
        points: Points that take part in the estimation.
        inliers: Points that the chosen motion explains.
        pixels: (N, 2) left-image pixels of the tracked corners, for display.
        is_inlier: (N,) whether each of these corners is an inlier.
        ages: (N,) number of earlier frames that saw each of these corners.
        rejected: Check of tracking or stereo matching -> number of corners that failed it.
        rms_px: RMS reprojection error of the inliers under the chosen motion, per direction and without the share of
            the points' own uncertainty; None where there are none.
        own_inliers: Points that the pair's own motion explains, or None where there is but one pair or too few points.
        own_rms_px: RMS error of the points that the pair's own motion explains, under that motion, or None; much less
            than ``rms_px`` is a sign of wrong extrinsics.
    """

    points: int
    inliers: int
    pixels: Float
    is_inlier: np.ndarray[tuple[int], np.dtype[np.bool_]]
    ages: Int | None = None
    rejected: Mapping[str, int] = field(default_factory=dict)
    rms_px: float | None = None
    own_inliers: int | None = None
    own_rms_px: float | None = None


class ByVelocities(NamedTuple):
    """Dependence of a motion by rolling shutters on the velocities with which their lines were compensated.

    Attributes:
        used: (2, 3) velocities that were used: of body at the later and at the earlier instant, in body there, m/s.
        derivatives: (2, 6, 3) derivatives of the motion that is measured with these, with respect to the true
            velocities, tangent ``[rotation, translation]`` in the body frame of the later instant.
        covariances: (2, 3, 3) covariances of the velocities that were used.
    """

    used: Float
    derivatives: Float
    covariances: Float

    @property
    def covariances_of_motion(self) -> Float:
        """Covariances (2, 6, 6) of the motion by errors of the velocities, now and at the reference."""
        return np.array([by @ each @ by.T for by, each in zip(self.derivatives, self.covariances, strict=True)])


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """A measured motion of the rig.

    Attributes:
        reference_stamp_ns: Stamp of the earlier frameset.
        stamp_ns: Stamp of the later frameset.
        reference_T_current: (4, 4) motion of body, as a between factor takes it.
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame of the later instant.
        shared_covariance: (6, 6) the part of it that all motions from this reference have in common, same tangent.
        inliers: Number of points that the motion explains.
        by_depth_errors: (P, 2, 6) derivatives with respect to two errors of each pair's inverse depths: an offset of
            all, 1/m, and a relative error. They are in the opposite direction of the same tangent: that of the
            reference's motion, seen from body at the later instant. Zero for pairs that did not measure the motion,
            None where errors of pairs are not estimated.
        calibration_covariance: (6, 6) covariance that errors of the calibration add to the motion's innovation, same
            tangent, or None where they add nothing. Innovation tests allow for it.
        by_velocities: Dependence on velocities of a motion by rolling shutters, for estimators of these velocities, or
            None. The covariance does not include errors of the velocities; that of `with_any_velocity` does.
        pairs: Indices of the pairs and single cameras that measured the motion; only for one of several hypotheses and
            for a partial motion.
    """

    reference_stamp_ns: int
    stamp_ns: int
    reference_T_current: Float
    covariance: Float
    shared_covariance: Float
    inliers: int
    by_depth_errors: Float | None = None
    calibration_covariance: Float | None = None
    by_velocities: ByVelocities | None = None
    pairs: tuple[int, ...] = ()

    def with_any_velocity(self) -> RelativeMotion:
        """Return the motion with a covariance that includes errors of the velocities in ``by_velocities``."""
        if self.by_velocities is None:
            return self
        return replace(self.with_errors(*self.by_velocities.covariances_of_motion), by_velocities=None)

    def with_errors(self, now: Float, then: Float) -> RelativeMotion:
        """Return the motion with the covariances (6, 6) of more errors, now and at the reference.

        All motions from the reference share the latter, if they share anything.
        """
        shared = self.shared_covariance + then if self.shared_covariance.any() else self.shared_covariance
        return replace(self, covariance=self.covariance + now + then, shared_covariance=shared)

    @property
    def duration_s(self) -> float:
        """Time between the two framesets."""
        return (self.stamp_ns - self.reference_stamp_ns) * 1e-9

    @cached_property
    def weakest_sigmas(self) -> tuple[float, float]:
        """Standard deviations in the least known directions: of the rotation, rad, and the translation, m."""
        blocks = np.stack([self.covariance[:3, :3], self.covariance[3:, 3:]])
        rotation, translation = np.sqrt(np.linalg.eigvalsh(blocks)[:, -1])
        return float(rotation), float(translation)


class CrossCameraMatches(NamedTuple):
    """Matches of a single camera's tracks in another camera at the same instant.

    Attributes:
        camera: index of the other camera.
        rows: (M,) rows of the tracks in `CameraTracks`.
        rays: (M, 2) normalised coordinates in the other camera.
    """

    camera: int
    rows: Int
    rays: Float


class HandedOverTracks(NamedTuple):
    """Tracks of a single camera that continue tracks of other cameras.

    Attributes:
        rows: (M,) rows of the tracks in `CameraTracks`.
        cameras: (M,) index of the camera in which the point was tracked first.
        ids: (M,) identity of the track in that camera.
    """

    rows: Int
    cameras: Int
    ids: Int


GLOBAL_SHUTTER = np.zeros((0, 4))  # rows of `CameraTracks.readout`
_NONE_HANDED_OVER = HandedOverTracks(*(np.zeros(0, dtype=np.int64) for _ in range(3)))


class CameraTracks(NamedTuple):
    """The tracks of one single camera at an instant.

    Attributes:
        ids: (N,) identities of its tracks, increasing.
        rays: (N, 2) normalised coordinates; those of a rolling shutter are corrected for its rotation since the stamp.
        matches: the same tracks in other cameras whose views overlap.
        handed_over: those of the tracks that continue tracks of other cameras.
        readout: (N, 4) exposure of each track's line, for a rolling shutter: ``[seconds, x, y, z]``, the time from the
            stamp to the exposure, and the camera's displacement until then, metres, in body at the stamp. It includes
            the effect of rotation and specific force, but not that of velocity and gravity. (0, 4) for a global
            shutter.
    """

    ids: Int
    rays: Float
    matches: tuple[CrossCameraMatches, ...] = ()
    handed_over: HandedOverTracks = _NONE_HANDED_OVER
    readout: Float = GLOBAL_SHUTTER


class LocatedPoints(NamedTuple):
    """Points of known position that one single camera sees at an instant.

    Attributes:
        ids: (N,) identities of its tracks, increasing.
        points_body: (N, 3) positions in body, metres.
        covariances: (N, 3, 3) covariances of the positions, m^2.
    """

    ids: Int
    points_body: Float
    covariances: Float


@dataclass(frozen=True, eq=False)
class VisualResult:
    """The front-end's result for one frameset.

    Attributes:
        motion: The measured motion, or None.
        quality: How far the motion can be trusted.
        reason: Reason why the motion is not good, or empty.
        pairs: Pair index -> report of the pair.
        alternatives: Motion hypotheses with their own covariances, where pairs contradict each other.
        is_calibration_trusted: Whether contradictions are attributed to the scene or to a knock, and not to the rig
            file; always where the calibration is not estimated.
        partial_motion: Where too few points are in view for a motion, the motion that an IMU predicts, corrected by
            these points; its covariance is that of the correction, and large in directions that they do not determine.
        own: At the end of a keyframe, pair index -> motion of body by this pair alone, with the rig's extrinsics.
        is_stationary: Whether the images have shown no motion for a while.
        frozen: Pairs that were left out because a camera of theirs repeats an image.
        camera_tracks: For a rig without pairs, camera index -> its tracks, from which the back-end measures the motion.
        stage_ms: Processing time by stage, milliseconds: ``track``, with all pairs side by side; its parts ``pyramid``,
            ``register``, ``flow`` and ``stereo``, each of the pair that took longest; then ``motion``, ``quality``, and
            ``replenish``, which is next to nothing unless the reference changes.
    """

    motion: RelativeMotion | None
    quality: Quality
    reason: str
    pairs: Mapping[int, PairReport]
    alternatives: tuple[RelativeMotion, ...] = ()
    is_calibration_trusted: bool = True
    partial_motion: RelativeMotion | None = None
    own: Mapping[int, RelativeMotion] = field(default_factory=dict)
    is_stationary: bool = False
    frozen: frozenset[int] = frozenset()
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    camera_tracks: Mapping[int, CameraTracks] = field(default_factory=dict)
