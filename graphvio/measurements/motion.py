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
    """How far a measured motion can be trusted."""

    GOOD = "good"
    """Its covariance is consistent."""
    WEAK = "weak"
    """Something speaks against it, as its reason says; its covariance is enlarged."""
    FAILED = "failed"
    """There is no motion."""


@dataclass(frozen=True, slots=True, eq=False)
class PairReport:
    """What one stereo pair contributed to a frameset.

    Attributes:
        points: Points that take part in the estimation.
        inliers: Points that the chosen motion explains.
        pixels: (N, 2) left-image pixels of the tracked corners, for display.
        is_inlier: (N,) whether each of them is an inlier.
        ages: (N,) number of earlier frames that saw each of them.
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
    """How a motion that rolling shutters measure depends on the velocities by which their lines were compensated.

    Attributes:
        used: (2, 3) m/s, of body at the later instant and at the earlier one, in body there.
        derivatives: (2, 6, 3) of the motion as it is measured with these, with respect to the true velocities, tangent
            ``[rotation, translation]`` in the body frame of the later instant.
        covariances: (2, 3, 3) of the velocities that were used.
    """

    used: Float
    derivatives: Float
    covariances: Float


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """A measured motion of the rig.

    Attributes:
        reference_stamp_ns: Stamp of the earlier frameset.
        stamp_ns: Stamp of the later frameset.
        reference_T_current: (4, 4) of body: the motion that a between factor takes.
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame of the later instant.
        shared_covariance: (6, 6) the part of it that all motions from this reference have in common, same tangent.
        inliers: Number of points that it explains.
        by_depth_errors: (P, 2, 6) derivatives with respect to an offset of all inverse depths of a pair, 1/m, and to a
            share of them, in the opposite direction of the same tangent: what the reference does, seen from body now.
            Zero for pairs that did not measure it, None where errors of pairs are not estimated.
        calibration_covariance: (6, 6) of what errors of the calibration add to its innovation, same tangent, or None
            where they add nothing. Innovation tests allow for it.
        by_velocities: Of rolling shutters, for those who estimate the velocities. The covariance does not allow for
            errors of these; that of `with_any_velocity` does.
        pairs: Indices of the pairs and single cameras whose motion it is, of one of several hypotheses and of a partial
            motion.
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
        """Return the motion with a covariance that allows for errors of the velocities that rolling shutters need."""
        if self.by_velocities is None:
            return self
        _, derivatives, covariances = self.by_velocities
        now, then = (each @ covariance @ each.T for each, covariance in zip(derivatives, covariances, strict=True))
        shared = self.shared_covariance + then if self.shared_covariance.any() else self.shared_covariance
        return replace(self, covariance=self.covariance + now + then, shared_covariance=shared, by_velocities=None)

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
    """Where another camera sees tracks of a single camera at the same instant.

    Attributes:
        camera: index of the other camera.
        rows: (M,) of the tracks.
        rays: (M, 2) normalised coordinates in the other camera.
    """

    camera: int
    rows: Int
    rays: Float


class HandedOverTracks(NamedTuple):
    """Tracks of a single camera that follow points which another camera's tracks began.

    Attributes:
        rows: (M,) of the tracks.
        cameras: (M,) index of the camera whose track began.
        ids: (M,) identity of that track.
    """

    rows: Int
    cameras: Int
    ids: Int


GLOBAL_SHUTTER = np.zeros((0, 4))  # rows of `CameraTracks.readout`
_NONE_HANDED_OVER = HandedOverTracks(*(np.zeros(0, dtype=np.int64) for _ in range(3)))


class CameraTracks(NamedTuple):
    """What one single camera sees at an instant.

    Attributes:
        ids: (N,) identities of its tracks, increasing.
        rays: (N, 2) normalised coordinates; those of a rolling shutter are as if it had not turned since the stamp.
        matches: the same tracks in other cameras whose views overlap.
        handed_over: which of them follow points of other cameras' tracks.
        readout: (N, 4) of a rolling shutter, when and from where a line sees: ``[seconds, x, y, z]`` from the stamp to
            the line's exposure, and the camera's way until then in metres, frame body at the stamp, by turn and
            specific force: without what velocity and gravity add. (0, 4) of a global shutter.
    """

    ids: Int
    rays: Float
    matches: tuple[CrossCameraMatches, ...] = ()
    handed_over: HandedOverTracks = _NONE_HANDED_OVER
    readout: Float = GLOBAL_SHUTTER


class LocatedPoints(NamedTuple):
    """Points that one single camera sees at an instant, and where they are.

    Attributes:
        ids: (N,) identities of its tracks, increasing.
        points_body: (N, 3) metres, in body.
        covariances: (N, 3, 3) m^2 of these.
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
        reason: Why it is not good, or empty.
        pairs: Pair index -> report of the pair.
        alternatives: Motion hypotheses with their own covariances, where pairs contradict each other.
        partial_motion: Where too few points are in view for a motion, the predicted one as they correct it, if an IMU
            predicts it; its covariance is of what they show, and large in directions that they do not show.
        own: At the end of a keyframe, pair index -> its own motion of body by the rig's extrinsics.
        is_stationary: Whether the images have shown no motion for a while.
        frozen: Pairs that were left out because a camera of theirs repeats an image.
        camera_tracks: Of a rig without pairs, camera index -> its tracks; the back-end then measures the motion.
        stage_ms: Processing time by stage, milliseconds: ``track``, with all pairs side by side; its parts ``pyramid``,
            ``register``, ``flow`` and ``stereo``, each of the pair that took longest; then ``motion``, ``quality``, and
            ``replenish``, which is next to nothing unless the reference changes.
    """

    motion: RelativeMotion | None
    quality: Quality
    reason: str
    pairs: Mapping[int, PairReport]
    alternatives: tuple[RelativeMotion, ...] = ()
    partial_motion: RelativeMotion | None = None
    own: Mapping[int, RelativeMotion] = field(default_factory=dict)
    is_stationary: bool = False
    frozen: frozenset[int] = frozenset()
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    camera_tracks: Mapping[int, CameraTracks] = field(default_factory=dict)
