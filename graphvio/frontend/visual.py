"""The visual front-end of a rig with stereo pairs: framesets in, relative poses of the rig with covariance out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.imaging.images import ImageMask
from graphvio.frontend.lookalikes import without_lookalikes
from graphvio.frontend.motion.depth_errors import by_depth_errors
from graphvio.frontend.motion.depth_scale import is_of_singles, with_free_length
from graphvio.frontend.motion.few_points import FewPoints, fit_few_points
from graphvio.frontend.motion.quality import CheckedHypothesis, checked_hypothesis, motion_with_quality, stereo_share
from graphvio.frontend.motion.refinement import Refined
from graphvio.frontend.motion.selection import best_pair_motion, joint_motion
from graphvio.frontend.pairs.agreement import Agreement, MotionHypothesis, agree, is_supported
from graphvio.frontend.pairs.pair_reports import inliers_of, pair_reports
from graphvio.frontend.readouts import Readouts, is_velocity_known, readout_sigma_px
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.frontend.tracking_frontend import MotionPredictor, TrackedFrameset, TrackingFrontend
from graphvio.geometry import se3_inverse, so3_log
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.rig import Rig
from graphvio.timing import timed

_MAX_READOUT_SIGMA_PX = 0.2  # of tracks that the self-calibration uses
_MIN_NOISE_SHARE = 0.5  # of the modelled noise, at least: the few corners before blank walls are not matched better


class _JudgedMotion(NamedTuple):
    """The motion of a frameset, its quality with the reason, and the motion hypotheses that contradict each other."""

    motion: RelativeMotion | None
    quality: Quality
    reason: str
    alternatives: tuple[RelativeMotion, ...] = ()


class VisualFrontend(TrackingFrontend):
    """Tracks every pair and estimates the rig's motion since a reference frameset (sections 2 and 3).

    Args:
        rig: Stereo pairs, and single cameras beside them.
        config: Configuration of all stages.
        image_mask: Function that makes a mask for each image, or None.

    Attributes:
        stage_ms: Processing time by stage of the newest frameset, milliseconds.
        are_velocities_known: Whether the velocity by which the rolling shutters of the newest frameset were compensated
            is known, and not only a guess; True without rolling shutters.
    """

    def __init__(self, rig: Rig, config: Config, image_mask: ImageMask | None = None) -> None:
        super().__init__(rig, config, image_mask)
        self._baselines_m = _baselines_m(rig)
        # Wrong focal lengths and baselines scale all motions by one factor, which no residual shows. With an IMU, its
        # variance is added to the covariance, so that vision does not correct the IMU's scale; without an IMU, nothing
        # measures the scale.
        file_error_share = 0.0 if config.estimates_calibration else config.motion.calibration_error_share
        error_share = float(np.hypot(config.motion.shared_error_share, file_error_share))
        self._scale_sigma = 0.0 if rig.imu is None else error_share
        self._noise_px = config.motion.pixel_sigma_px  # by the residuals of the last good motion
        self._is_reference_of_few = False  # whether the reference began with too few points for a motion
        self._readouts = Readouts(rig) if self._has_rolling_shutter else None
        self.are_velocities_known = True
        self._contradicted_ns: int | None = None  # when two pairs' motions last differed by over 5 sigma

    @property
    def are_lines_off(self) -> bool:
        """Whether the corners of some pair are matched on lines beside the epipolar lines of the calibration."""
        return any(tracker.are_lines_off for tracker in self._trackers)

    def recalibrate(
        self, rig: Rig, epipolar_margin_px: float, uncertain: Mapping[int, Float] = MappingProxyType({})
    ) -> None:
        """Use another calibration of the same cameras from the next frameset on.

        Points of the references are triangulated again, so that every motion is measured with a single calibration.

        Args:
            rig: the rig, with the new calibration.
            epipolar_margin_px: by how much its epipolar lines may be off, pixels; added to the largest epipolar error
                of a match.
            uncertain: index of a pair or single camera -> covariance (6, 6) of its extrinsics relative to the first
                pair, see `agree`.
        """
        new_T_old = rig.pairs[0].left.body_T_cam @ self._rig.pairs[0].left.cam_T_body
        for history in self._histories:
            history.recalibrate(new_T_old)
        self._baselines_m = _baselines_m(rig)
        self._recalibrate(rig, epipolar_margin_px, uncertain)

    def compensated_frames_at(self, stamp_ns: int) -> dict[int, TrackedFrame]:
        """Return the tracks as `frames_at` does, without those whose rolling shutter is not compensated exactly.

        These are tracks of single cameras, while their depths are hardly known.
        """
        frames = self.frames_at(stamp_ns)
        if self._readouts is not None:
            for j, frame in frames.items():
                if frame.is_single and self._rig.groups[j].left.line_time_us:
                    sigma_px = readout_sigma_px(frame, self._references.of(j), self._rig.groups[j].left.focal_px)
                    frames[j] = frame.keep(sigma_px * self._config.motion.pixel_sigma_px < _MAX_READOUT_SIGMA_PX)
        return {j: frame for j, frame in frames.items() if len(frame.ids) or not frame.is_single}

    def compensated_by_both_sides(
        self, stamp_ns: int, frames: Mapping[int, TrackedFrame]
    ) -> dict[int, TrackedFrame] | None:
        """Compensate rolling shutters of an earlier frameset again, by motions before and after it.

        Args:
            stamp_ns: stamp of the frameset.
            frames: its tracks, by the index of the pair or single camera.

        Returns:
            The tracks, compensated again, or None while there is no later frameset, or without rolling shutters.
        """
        return None if self._readouts is None else self._readouts.compensated_by_both_sides(stamp_ns, frames, self._rig)

    # ------------------------------------------------------------------ one frameset

    def _measure(self, seen: TrackedFrameset, motion_since: MotionPredictor) -> VisualResult:
        """Measure the motion of the rig from its reference to a frameset."""
        contradicted_ns = self._contradicted_ns
        seen = self._with_unknown_depths(seen, motion_since)
        agreement, reason = self._estimate_motion(seen, motion_since)
        if self._readouts is not None:
            if agreement is not None:
                seen, agreement, reason = self._with_shown_velocities(
                    seen, self._readouts, agreement, motion_since, contradicted_ns
                )
            self._readouts.keep(seen, self._references)
            self.are_velocities_known = is_velocity_known(seen.readout)
        few = self._fit_few_points(seen, motion_since) if agreement is None else None
        judged = self._judge(seen, agreement, reason, motion_since)
        if agreement is not None and judged.quality is Quality.GOOD:
            self._noise_px = self._shown_noise_px(agreement)
        is_stationary = self._detect_standstill(seen, agreement)
        self._drop_outliers(seen, agreement)
        replenished, own = self._start_keyframe_if_due(seen, agreement, few, motion_since)
        return VisualResult(
            judged.motion,
            judged.quality,
            judged.reason,
            pair_reports(seen.frames if seen.reference else replenished, seen.correspondences, agreement, replenished),
            alternatives=judged.alternatives,
            partial_motion=None if few is None else self._partial_motion(seen, few),
            own=own,
            is_stationary=is_stationary,
            frozen=seen.frozen.pairs,
            stage_ms=self.stage_ms,
        )

    @timed("motion")
    def _estimate_motion(self, seen: TrackedFrameset, motion_since: MotionPredictor) -> tuple[Agreement | None, str]:
        """Estimate the motion from all pairs, eq. (1) to (4), or return None and the reason why there is none."""
        if not seen.reference:
            return None, seen.frozen.reason if self._all_frozen or not seen.frames else "first images"
        config, observations, arrays = self._config.motion, seen.correspondences.observations, self._extrinsics.arrays
        if len(observations.pair) < config.min_inliers:
            return None, f"only {len(observations.pair)} points in view"
        rng = np.random.default_rng([config.seed, seen.stamp_ns % 2**63])
        predicted = motion_since(seen.reference_stamp_ns)
        start = np.eye(4) if predicted is None else predicted
        if config.selection == "joint":
            refined, observations = joint_motion(arrays, observations, start, config, rng)
            in_doubt = self._is_in_doubt(seen.stamp_ns)
            shared = None if self._readouts is None else self._readouts.shared_errors(seen, arrays, self._noise_px)
            agreement = agree(arrays, observations, refined, config, rng, self._extrinsics.uncertain, in_doubt, shared)
            if agreement.contradicts:
                self._contradicted_ns = seen.stamp_ns
            if len(agreement.hypotheses) > 1:
                agreement = without_lookalikes(agreement, seen, self._trackers, arrays.body_T_left)
        else:
            refined = best_pair_motion(arrays, observations, start, config, rng)
            agreement = Agreement((MotionHypothesis(observations.pairs, refined),), {})
        best = agreement.hypotheses[0]
        rows = np.isin(observations.pair, best.pairs)
        if not is_supported(best.refined.inlier[rows], config):
            return None, f"the best motion explains only {best.support} of {int(rows.sum())} points"
        return agreement, ""

    def _with_unknown_depths(self, seen: TrackedFrameset, motion_since: MotionPredictor) -> TrackedFrameset:
        """Add the effect of unknown depths on rolling shutters to the covariances of single cameras' points."""
        if self._readouts is None or not seen.correspondences.singles:
            return seen
        predicted = motion_since(seen.reference_stamp_ns)
        start = np.eye(4) if predicted is None else predicted
        return self._readouts.with_unknown_depths(seen, self._extrinsics.arrays, start)

    def _with_shown_velocities(
        self,
        seen: TrackedFrameset,
        readouts: Readouts,
        agreement: Agreement,
        motion_since: MotionPredictor,
        contradicted_ns: int | None,
    ) -> tuple[TrackedFrameset, Agreement | None, str]:
        """Measure a motion again, with rolling shutters compensated by the velocities that it shows, if none are known.

        ``contradicted_ns`` is when the pairs last contradicted each other before this frameset. It is restored for the
        second estimate, since wrong velocities may make the pairs contradict each other.
        """
        readouts.note(seen, agreement.hypotheses[0].refined.cur_T_ref)
        again = readouts.compensated_by_motion(seen, self._trackers, self._references, self._rig)
        if again is None:
            return seen, agreement, ""
        again = self._with_unknown_depths(again, motion_since)
        self._latest.update(again.frames)
        self._contradicted_ns = contradicted_ns
        better, reason = self._estimate_motion(again, motion_since)
        if better is not None:
            readouts.note(again, better.hypotheses[0].refined.cur_T_ref)
        return again, better, reason

    @timed("motion")
    def _fit_few_points(self, seen: TrackedFrameset, motion_since: MotionPredictor) -> FewPoints | None:
        """Correct a motion that an IMU predicts by points that are too few to measure a motion.

        Only points of stereo pairs are used, since depths of single cameras have no scale of their own. If most corners
        are not found in the right images, there is no result: the few that are found may all be wrong in the same way.
        """
        if not seen.reference or self._rig.imu is None or seen.frozen.all_since_ns is not None:
            return None
        observations = seen.correspondences.observations
        is_of_pair = observations.pair < len(self._rig.pairs)
        if not is_of_pair.any() or len(observations.pair) >= self._config.motion.min_inliers:
            return None
        if stereo_share(seen.reference, seen.frames, self._baselines_m).share < THRESHOLDS.quality.min_stereo_share:
            return None
        predicted = motion_since(seen.reference_stamp_ns)
        if predicted is None:
            return None
        arrays, of_pairs = self._extrinsics.arrays, observations.of_rows(is_of_pair)
        few = fit_few_points(arrays, of_pairs, predicted, self._noise_px, self._config.motion.max_error_px)
        if few is None:
            return None
        inlier = np.zeros(len(is_of_pair), dtype=bool)
        inlier[is_of_pair] = few.inlier
        return few._replace(inlier=inlier)

    @timed("quality")
    def _judge(
        self, seen: TrackedFrameset, agreement: Agreement | None, reason: str, motion_since: MotionPredictor
    ) -> _JudgedMotion:
        """Return the motion with its quality, and with a covariance that failed checks have enlarged."""
        if agreement is None:
            return _JudgedMotion(None, Quality.FAILED, reason)
        arrays, observations = self._extrinsics.arrays, seen.correspondences.observations
        predicted = motion_since(seen.reference_stamp_ns) if self._rig.singles else None

        def with_length(motion: RelativeMotion, hypothesis: MotionHypothesis) -> RelativeMotion:
            return with_free_length(arrays, observations, hypothesis.refined, motion, predicted)

        hypotheses, best = self._checked_hypotheses(seen, agreement), agreement.hypotheses[0]
        has_length = not is_of_singles(arrays, observations, best.refined)
        motion, quality, reason = motion_with_quality(hypotheses, agreement.max_distance, has_length=has_length)
        alternatives = tuple(
            replace(with_length(checked_one.motion, hypothesis), pairs=hypothesis.pairs)
            for checked_one, hypothesis in zip(hypotheses, agreement.hypotheses, strict=True)
            if len(hypotheses) > 1
        )
        return _JudgedMotion(with_length(motion, best), quality, reason, alternatives)

    @timed("quality")
    def _detect_standstill(self, seen: TrackedFrameset, agreement: Agreement | None) -> bool:
        """Return whether the points that the motion explains have stood still for a while; False without a motion."""
        if agreement is None:
            return False
        explained = seen.correspondences.identities(seen.frames, agreement.hypotheses[0].refined.inlier)
        return self._standstill.update(seen.frames, explained)

    @timed("quality")
    def _drop_outliers(self, seen: TrackedFrameset, agreement: Agreement | None) -> None:
        """Drop the tracks that are no inliers, see `inliers_of`; without a motion, drop none."""
        if agreement is None:
            return
        for j, rows in seen.correspondences.rows.items():
            self._trackers[j].drop(seen.frames[j].ids[rows[~inliers_of(j, seen.correspondences, agreement)]])

    @timed("replenish")
    def _start_keyframe_if_due(
        self,
        seen: TrackedFrameset,
        agreement: Agreement | None,
        few: FewPoints | None,
        motion_since: MotionPredictor,
    ) -> tuple[dict[int, TrackedFrame], dict[int, RelativeMotion]]:
        """Start a keyframe with new corners if `References` asks for one, or if no motion could be measured.

        A keyframe that began with too few points for a motion may go on without one. The pairs' own motions over a
        keyframe that ends are used to correct the extrinsics between pairs.

        Returns:
            Pair index -> tracks with new corners, and pair index -> its own motion over the keyframe that ends; both
            are empty if the keyframe goes on.
        """
        if agreement is None:
            # A keyframe with full motions ends here: its points' shared covariance is not that of the few left.
            goes_on = (
                few is not None
                and self._is_reference_of_few
                and not self._references.must_be_replaced_after_few(seen.frames, seen.correspondences, few.inlier)
            )
            self._is_reference_of_few = True
            return ({} if goes_on else self._refer_to(seen.frames)), {}
        self._is_reference_of_few = False
        refined, is_contradicted = agreement.hypotheses[0].refined, len(agreement.hypotheses) > 1
        # While pairs contradict each other, many short motions show soonest which one is right.
        if not is_contradicted and not self._references.must_be_replaced(
            seen.frames, seen.correspondences, refined.inlier
        ):
            return {}, {}
        own = self._own_motions(seen, agreement)
        self._extrinsics.learn(agreement.own)
        self._move_trackers()
        self._advance_histories(seen, refined, motion_since)
        return self._refer_to(seen.frames), own

    # ------------------------------------------------------------------ parts of these steps

    def _shown_noise_px(self, agreement: Agreement) -> float:
        """Return the pixel noise that the residuals of a motion show, inflated as in the motion's covariance."""
        config = self._config.motion
        rms_px = agreement.hypotheses[0].refined.rms_px() or config.pixel_sigma_px
        return max(config.sigma_inflation * rms_px, _MIN_NOISE_SHARE * config.pixel_sigma_px)

    def _advance_histories(self, seen: TrackedFrameset, refined: Refined, motion_since: MotionPredictor) -> None:
        """Store the motion over the keyframe that ends, from which depths of single cameras' points are computed."""
        # A motion that single cameras alone have measured has the scale of earlier depths; the prediction's is better.
        are_singles = is_of_singles(self._extrinsics.arrays, seen.correspondences.observations, refined)
        predicted = motion_since(seen.reference_stamp_ns) if are_singles else None
        cur_T_ref = refined.cur_T_ref if predicted is None else predicted
        covariance = refined.covariance
        if self._readouts is not None and self._rig.singles:
            errors, by_rates = self._readouts.errors(
                seen, self._extrinsics.arrays, refined.inlier, refined.cur_T_ref, self._noise_px
            )
            covariance = covariance + (errors.covariances_of_motion + by_rates).sum(axis=0)
        for j in seen.frames:
            self._histories[j].advance(seen.reference_stamp_ns, seen.stamp_ns, cur_T_ref, covariance)

    def _is_in_doubt(self, now_ns: int) -> bool:
        """Return whether the pairs contradicted each other a moment ago."""
        return self._contradicted_ns is not None and 0 <= now_ns - self._contradicted_ns < THRESHOLDS.agreement.doubt_ns

    def _checked_hypotheses(self, seen: TrackedFrameset, agreement: Agreement) -> list[CheckedHypothesis]:
        """Apply the quality checks to each motion hypothesis on its own."""
        stereo = stereo_share(seen.reference, seen.frames, self._baselines_m)
        return [
            checked_hypothesis(
                self._with_nuisances(self._relative_motion(seen, hypothesis.refined), seen, hypothesis.refined),
                seen.frozen.all_since_ns,
                stereo,
                (hypothesis.refined.rms_px() or 0.0) / self._config.motion.pixel_sigma_px,
            )
            for hypothesis in agreement.hypotheses
        ]

    def _relative_motion(self, seen: TrackedFrameset, refined: Refined) -> RelativeMotion:
        ref_T_cur = se3_inverse(refined.cur_T_ref)
        scaled = self._scale_covariance(ref_T_cur)
        used_once = self._config.motion.reference == "previous"  # nothing is shared with another motion
        return RelativeMotion(
            seen.reference_stamp_ns,
            seen.stamp_ns,
            ref_T_cur,
            refined.covariance + scaled,
            np.zeros((6, 6)) if used_once else refined.shared_covariance,
            int(refined.inlier.sum()),
        )

    def _with_readout_errors(
        self, motion: RelativeMotion, seen: TrackedFrameset, refined: Refined | FewPoints
    ) -> RelativeMotion:
        """Add the effect of the velocities by which rolling shutters are compensated to a motion.

        Without an IMU no state has the linear velocities: their uncertainty is then added to the covariance instead.
        """
        if self._readouts is None:
            return motion
        errors, by_rates = self._readouts.errors(
            seen, self._extrinsics.arrays, refined.inlier, refined.cur_T_ref, self._noise_px
        )
        motion = replace(motion.with_errors(*by_rates), by_velocities=errors)
        return motion if seen.readout is not None and seen.readout.is_by_imu else motion.with_any_velocity()

    def _scale_covariance(self, ref_T_cur: Float) -> Float:
        """Return the covariance (6, 6) of a scale error, which is a share of a motion's angle and length."""
        angle, distance = np.linalg.norm(so3_log(ref_T_cur[:3, :3].copy())), np.linalg.norm(ref_T_cur[:3, 3])
        return np.diag(np.repeat([angle, distance], 3) ** 2 * self._scale_sigma**2)

    def _partial_motion(self, seen: TrackedFrameset, few: FewPoints) -> RelativeMotion:
        ref_T_cur = se3_inverse(few.cur_T_ref)
        scaled = self._scale_covariance(ref_T_cur)
        motion = RelativeMotion(
            seen.reference_stamp_ns,
            seen.stamp_ns,
            ref_T_cur,
            few.covariance + scaled,
            few.shared_covariance,
            int(few.inlier.sum()),
            pairs=seen.correspondences.observations.of_rows(few.inlier).pairs,
        )
        return self._with_nuisances(motion, seen, few)

    def _with_nuisances(
        self, motion: RelativeMotion, seen: TrackedFrameset, refined: Refined | FewPoints
    ) -> RelativeMotion:
        """Add the derivatives of a motion by nuisance variables: readout velocities and errors of the pairs' depths."""
        return self._with_depth_errors(self._with_readout_errors(motion, seen, refined), seen, refined)

    def _with_depth_errors(
        self, motion: RelativeMotion, seen: TrackedFrameset, refined: Refined | FewPoints
    ) -> RelativeMotion:
        """Add derivatives with respect to errors of the pairs' depths, which the innovation test needs."""
        if not self._config.estimates_calibration or self._rig.imu is None:
            return motion
        observations, cur_T_ref = seen.correspondences.observations, np.ascontiguousarray(refined.cur_T_ref)
        derivatives = by_depth_errors(self._extrinsics.arrays, observations, refined.inlier, cur_T_ref)
        return replace(motion, by_depth_errors=derivatives)

    def _own_motions(self, seen: TrackedFrameset, agreement: Agreement) -> dict[int, RelativeMotion]:
        """Return each pair's own motion by the rig's uncorrected extrinsics; with a single pair, the rig's motion."""
        first = agreement.hypotheses[0]
        alone = {first.pairs[0]: first.refined} if len(self._rig.groups) == 1 else {}
        return {
            j: self._relative_motion(seen, self._extrinsics.uncorrected(j, refined))
            for j, refined in (agreement.own or alone).items()
            if j < len(self._rig.pairs)
        }


def _baselines_m(rig: Rig) -> list[float]:
    """Return the baseline of each group of cameras, 0 for a single camera."""
    return [pair.baseline_m for pair in rig.pairs] + [0.0] * len(rig.singles)
