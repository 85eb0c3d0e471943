"""The visual front-end as the odometry uses it: framesets in, relative poses of the rig with covariance out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.config import Config
from graphvio.frontend.agreement import Agreement, MotionHypothesis, agree, is_supported
from graphvio.frontend.depth_errors import by_depth_errors
from graphvio.frontend.depth_scale import is_of_singles, with_free_length
from graphvio.frontend.extrinsic_monitor import ExtrinsicError
from graphvio.frontend.extrinsics import RigExtrinsics
from graphvio.frontend.frozen import Frozen, FrozenImages
from graphvio.frontend.images import ImageMask, checked
from graphvio.frontend.motion_stereo import MotionHistory
from graphvio.frontend.observations import Correspondences, correspond
from graphvio.frontend.pair_reports import inliers_of, pair_reports
from graphvio.frontend.quality import GradedHypothesis, graded, graded_hypothesis, stereo_share
from graphvio.frontend.references import References
from graphvio.frontend.refinement import Refined
from graphvio.frontend.rolling_shutter import ReadoutMotion
from graphvio.frontend.selection import best_pair_motion, joint_motion
from graphvio.frontend.standstill import Standstill
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.frontend.tracker import GroupTracker
from graphvio.frontend.tracks import TrackedFrame
from graphvio.geometry import se3_inverse, so3_log
from graphvio.measurements.motion import Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig
from graphvio.timing import timed

MotionPredictor = Callable[[int], Float | None]
"""Takes an earlier stamp and returns the predicted ``cur_T_then`` (4, 4) of body, or None if unknown."""

_Result = TypeVar("_Result")


class Seen(NamedTuple):
    """Tracks of a frameset.

    Attributes:
        stamp_ns: Stamp of the frameset.
        frozen: Which images repeat.
        frames: Pair index -> its tracks.
        reference: Pair index -> its tracks at the reference; empty if there is none.
        correspondences: Points of both.
    """

    stamp_ns: int
    frozen: Frozen
    frames: dict[int, TrackedFrame]
    reference: dict[int, TrackedFrame]
    correspondences: Correspondences

    @property
    def reference_stamp_ns(self) -> int:
        """Stamp of the reference, if there is one."""
        return next(iter(self.reference.values())).stamp_ns


class _Graded(NamedTuple):
    """The motion of a frameset, how far it can be trusted and why, and contradicting hypotheses."""

    motion: RelativeMotion | None
    quality: Quality
    reason: str
    alternatives: tuple[RelativeMotion, ...] = ()


class VisualFrontend:
    """Tracks every pair and estimates the rig's motion since a reference frameset (sections 2 and 3).

    Args:
        rig: Stereo pairs.
        config: Configuration of all stages.
        image_mask: Masks of each image, or None.

    Attributes:
        stage_ms: Processing time by stage of the newest frameset, milliseconds.
    """

    def __init__(self, rig: Rig, config: Config, image_mask: ImageMask | None = None) -> None:
        self.stage_ms: dict[str, float] = {}
        self._config = config
        self._rig = rig
        self._extrinsics = RigExtrinsics(rig, config)
        self._histories = [MotionHistory() for _ in rig.groups]  # of each, since they may be triggered by themselves
        self._trackers = [
            GroupTracker(group, config, history, image_mask)
            for group, history in zip(rig.groups, self._histories, strict=True)
        ]
        self._baselines_m = _baselines_m(rig)
        self._frozen = FrozenImages()
        self._all_frozen = False
        self._latest: dict[int, TrackedFrame] = {}
        self._references = References(config.motion)
        # Errors of focal lengths and baselines scale all motions alike. No residual shows that, and an IMU must not be
        # corrected by it; without an IMU nothing shows the scale, and as noise it would only be smoothed.
        of_file = 0.0 if config.estimates_calibration else config.motion.calibration_error_share
        self._scale_sigma = 0.0 if rig.imu is None else float(np.hypot(config.motion.shared_error_share, of_file))
        self._standstill = Standstill()
        self._has_rolling_shutter = any(camera.line_time_us for camera in rig.cameras)
        self._contradicted_ns: int | None = None  # when the pairs last were beyond 5 sigma of each other
        self._workers = ThreadPoolExecutor(len(rig.groups), thread_name_prefix="graphvio-pair")

    @property
    def reference_stamps_ns(self) -> frozenset[int]:
        """Stamps of the framesets that later motions will be measured from."""
        return self._references.stamps_ns

    @property
    def body_T_left(self) -> Float:
        """(P, 4, 4) of the groups' left cameras, with the corrections that are in force."""
        return self._extrinsics.arrays.body_T_left

    @property
    def extrinsic_errors(self) -> Mapping[int, ExtrinsicError]:
        """Pairs and single cameras whose extrinsics relative to the first pair are wrong: motions are corrected."""
        return self._extrinsics.extrinsic_errors

    @property
    def are_lines_off(self) -> bool:
        """Whether some pair's corners are found beside the epipolar lines of the calibration."""
        return any(tracker.are_lines_off for tracker in self._trackers)

    def frames_at(self, stamp_ns: int) -> dict[int, TrackedFrame]:
        """Return the tracks of pairs and single cameras at the newest frameset, if it has this stamp."""
        return {j: frame for j, frame in self._latest.items() if frame.stamp_ns == stamp_ns}

    def limit_corners(self, share: float) -> None:
        """Follow only a share, above 0 and up to 1, of the corners that the configuration asks for from now on."""
        for tracker in self._trackers:
            tracker.limit_corners(share)

    def recalibrate(
        self, rig: Rig, epipolar_margin_px: float, uncertain: Mapping[int, Float] = MappingProxyType({})
    ) -> None:
        """Take another calibration of the same cameras from the next frameset on.

        Points of the references are triangulated again, so that a motion is measured with one calibration.

        Args:
            rig: with the calibration.
            epipolar_margin_px: by how much it may move epipolar lines, added to what matches may be off.
            uncertain: index of a pair or single camera -> covariance (6, 6) of its extrinsics relative to the first
                pair, see `agree`.
        """
        new_T_old = rig.pairs[0].left.body_T_cam @ self._rig.pairs[0].left.cam_T_body
        for history in self._histories:
            history.recalibrate(new_T_old)
        self._rig = rig
        self._baselines_m = _baselines_m(rig)
        self._extrinsics.recalibrate(rig, uncertain)
        for tracker, group in zip(self._trackers, rig.groups, strict=True):
            tracker.recalibrate(group, epipolar_margin_px)
        self._move_trackers()
        self._references.recalibrate(rig)
        self._latest = {j: frame.recalibrated(rig.groups[j]) for j, frame in self._latest.items()}

    def start_keyframe(self) -> None:
        """Measure the next motions from the newest frameset."""
        self._references.clear()
        if not self._latest:
            return  # no image has come yet
        newest_ns = max(frame.stamp_ns for frame in self._latest.values())
        self._refer_to({j: frame for j, frame in self._latest.items() if frame.stamp_ns == newest_ns})

    def drop(self, outliers: Mapping[int, Int]) -> None:
        """Drop tracks that do not stand still: index of the pair or camera -> identities."""
        for j, ids in outliers.items():
            self._trackers[j].drop(ids)

    def close(self) -> None:
        """End the threads."""
        self._workers.shutdown()

    # ------------------------------------------------------------------ one frameset

    def process(
        self,
        frameset: FrameSet,
        motion_since: MotionPredictor,
        readout: ReadoutMotion | None = None,
        rotation_since: MotionPredictor | None = None,
    ) -> VisualResult:
        """Measure the motion of the rig from its reference to a frameset.

        Args:
            frameset: Images of any subset of pairs.
            motion_since: The back-end's predicted motion since an earlier stamp, from which the search begins.
            readout: Motion of body while rolling shutters read the images out; None continues that of the prediction.
            rotation_since: The rotation by the gyro alone, from which the search begins where no motion is predicted.

        Raises:
            RigError: If an image does not fit the rig; nothing has changed then.
        """
        self.stage_ms = {}
        seen = self._track(checked(frameset, self._rig), motion_since, readout, rotation_since)
        agreement, reason = self._estimate_motion(seen, motion_since)
        graded_motion = self._grade(seen, agreement, reason, motion_since)
        is_stationary = self._detect_standstill(seen, agreement)
        self._drop_outliers(seen, agreement)
        replenished, own = self._replenish(seen, agreement, motion_since)
        return VisualResult(
            graded_motion.motion,
            graded_motion.quality,
            graded_motion.reason,
            pair_reports(seen.frames if seen.reference else replenished, seen.correspondences, agreement, replenished),
            alternatives=graded_motion.alternatives,
            own=own,
            is_stationary=is_stationary,
            frozen=seen.frozen.pairs,
            stage_ms=self.stage_ms,
        )

    @timed("track")
    def _track(
        self,
        frameset: FrameSet,
        motion_since: MotionPredictor,
        readout: ReadoutMotion | None,
        rotation_since: MotionPredictor | None,
    ) -> Seen:
        """Track the corners of each pair whose images are not repeated, and match them left to right (section 2)."""
        frozen = self._frozen.update(frameset)
        self._all_frozen = frozen.all_since_ns is not None
        oldest_ns = frameset.stamp_ns - THRESHOLDS.reference.max_absence_ns
        for j in [j for j, frame in self._latest.items() if frame.stamp_ns < oldest_ns]:
            self._trackers[j].drop(self._latest.pop(j).ids)
            self._references.forget(j)

        if readout is None and self._has_rolling_shutter:
            readout = self._steady_readout(frameset.stamp_ns, motion_since)

        def observe(j: int) -> TrackedFrame:
            since_latest = self._predicted(j, self._latest.get(j), motion_since)
            if since_latest is None and rotation_since is not None:
                since_latest = self._predicted(j, self._latest.get(j), rotation_since)
            since_reference = self._predicted(j, self._references.of(j), motion_since)
            left, *right = frameset.images[j]
            masks = frameset.masks.get(j, (None, None))
            return self._trackers[j].observe(
                frameset.stamp_ns, left, right[0] if right else None, since_latest, since_reference, masks, readout
            )

        frames = self._in_parallel(observe, frameset.images.keys() - frozen.pairs)
        self._latest.update(frames)
        for stage in ("pyramid", "register", "flow", "stereo"):
            self.stage_ms[stage] = max((frame.stage_ms[stage] for frame in frames.values()), default=0.0)
        reference = self._references.shared(frames)
        return Seen(frameset.stamp_ns, frozen, frames, reference, correspond(reference, frames))

    @timed("motion")
    def _estimate_motion(self, seen: Seen, motion_since: MotionPredictor) -> tuple[Agreement | None, str]:
        """Estimate the motion from all pairs, eq. (1) to (4), or return None and why there is none."""
        if not seen.reference:
            return None, seen.frozen.reason if self._all_frozen or not seen.frames else "first images"
        config, observations = self._config.motion, seen.correspondences.observations
        if len(observations.pair) < config.min_inliers:
            return None, f"only {len(observations.pair)} points in view"
        rng = np.random.default_rng([config.seed, seen.stamp_ns % 2**63])
        predicted = motion_since(seen.reference_stamp_ns)
        start = np.eye(4) if predicted is None else predicted
        if config.selection == "joint":
            arrays = self._extrinsics.arrays
            refined, observations = joint_motion(arrays, observations, start, config, rng)
            in_doubt = self._is_in_doubt(seen.stamp_ns)
            agreement = agree(
                self._extrinsics.arrays, observations, refined, config, rng, self._extrinsics.uncertain, in_doubt
            )
            if agreement.contradicts:
                self._contradicted_ns = seen.stamp_ns
        else:
            refined = best_pair_motion(self._extrinsics.arrays, observations, start, config, rng)
            agreement = Agreement((MotionHypothesis(observations.pairs, refined),), {})
        best = agreement.hypotheses[0]
        rows = np.isin(observations.pair, best.pairs)
        if not is_supported(best.refined.inlier[rows], config):
            return None, f"the best motion explains only {best.support} of {int(rows.sum())} points"
        return agreement, ""

    @timed("quality")
    def _grade(self, seen: Seen, agreement: Agreement | None, reason: str, motion_since: MotionPredictor) -> _Graded:
        """Decide how far the motion can be trusted."""
        if agreement is None:
            return _Graded(None, Quality.FAILED, reason)
        arrays, observations = self._extrinsics.arrays, seen.correspondences.observations
        predicted = motion_since(seen.reference_stamp_ns) if self._rig.singles else None

        def with_length(motion: RelativeMotion, hypothesis: MotionHypothesis) -> RelativeMotion:
            return with_free_length(arrays, observations, hypothesis.refined, motion, predicted)

        hypotheses, best = self._graded_hypotheses(seen, agreement), agreement.hypotheses[0]
        has_length = not is_of_singles(arrays, observations, best.refined)
        motion, quality, reason = graded(hypotheses, agreement.max_distance, has_length=has_length)
        alternatives = tuple(
            replace(with_length(graded_one.motion, hypothesis), pairs=hypothesis.pairs)
            for graded_one, hypothesis in zip(hypotheses, agreement.hypotheses, strict=True)
            if len(hypotheses) > 1
        )
        return _Graded(with_length(motion, best), quality, reason, alternatives)

    @timed("quality")
    def _detect_standstill(self, seen: Seen, agreement: Agreement | None) -> bool:
        """Return whether the points that the motion explains have stood still for a while; False without a motion."""
        if agreement is None:
            return False
        explained = seen.correspondences.identities(seen.frames, agreement.hypotheses[0].refined.inlier)
        return self._standstill.update(seen.frames, explained)

    @timed("quality")
    def _drop_outliers(self, seen: Seen, agreement: Agreement | None) -> None:
        """Drop the tracks that the motion does not explain; none without a motion."""
        if agreement is None:
            return
        for j, rows in seen.correspondences.rows.items():
            self._trackers[j].drop(seen.frames[j].ids[rows[~inliers_of(j, seen.correspondences, agreement)]])

    @timed("replenish")
    def _replenish(
        self, seen: Seen, agreement: Agreement | None, motion_since: MotionPredictor
    ) -> tuple[dict[int, TrackedFrame], dict[int, RelativeMotion]]:
        """Start a keyframe with new corners if it is time to, and learn from the pairs' own motions until then.

        Returns:
            Pair index -> tracks with new corners, and pair index -> its own motion over the keyframe; empty where the
            keyframe goes on.
        """
        if agreement is None:
            return self._refer_to(seen.frames), {}
        refined, is_contradicted = agreement.hypotheses[0].refined, len(agreement.hypotheses) > 1
        if not self._references.must_be_replaced(seen.frames, seen.correspondences, refined, is_contradicted):
            return {}, {}
        own = self._own_motions(seen, agreement)
        self._extrinsics.learn(agreement.own)
        self._move_trackers()
        # Depths by a motion of single cameras alone would have the scale of earlier depths: that of the state is known.
        are_singles = is_of_singles(self._extrinsics.arrays, seen.correspondences.observations, refined)
        predicted = motion_since(seen.reference_stamp_ns) if are_singles else None
        cur_T_ref = refined.cur_T_ref if predicted is None else predicted
        for j in seen.frames:
            self._histories[j].advance(seen.reference_stamp_ns, seen.stamp_ns, cur_T_ref, refined.covariance)
        return self._refer_to(seen.frames), own

    # ------------------------------------------------------------------ parts of these steps

    def _is_in_doubt(self, now_ns: int) -> bool:
        """Whether the pairs contradicted each other a moment ago."""
        return self._contradicted_ns is not None and 0 <= now_ns - self._contradicted_ns < THRESHOLDS.agreement.doubt_ns

    def _in_parallel(self, work: Callable[[int], _Result], pairs: Iterable[int]) -> dict[int, _Result]:
        """Work on each pair, all but the first in threads of their own."""
        ordered = sorted(pairs)
        others = [(j, self._workers.submit(work, j)) for j in ordered[1:]]
        frames = {j: work(j) for j in ordered[:1]}
        return frames | {j: other.result() for j, other in others}

    def _predicted(self, pair: int, then: TrackedFrame | None, motion_since: MotionPredictor) -> Float | None:
        """Predict the motion of points in a pair's left camera since one of its frames."""
        return None if then is None else self._moved(pair, motion_since(then.stamp_ns))

    def _moved(self, pair: int, cur_T_then: Float | None) -> Float | None:
        """Return the motion of points in a pair's left camera for one of body, by eq. (1)."""
        if cur_T_then is None:
            return None
        body_T_left = self._extrinsics.arrays.body_T_left[pair]
        return np.asarray(se3_inverse(body_T_left) @ cur_T_then @ body_T_left)

    def _steady_readout(self, stamp_ns: int, motion_since: MotionPredictor) -> ReadoutMotion | None:
        """Continue the predicted motion since the images before, or return None where there is none."""
        before_ns = max((frame.stamp_ns for frame in self._latest.values()), default=stamp_ns)
        cur_T_before = motion_since(before_ns) if before_ns < stamp_ns else None
        return None if cur_T_before is None else ReadoutMotion.steady(cur_T_before, 1e-9 * (stamp_ns - before_ns))

    def _refer_to(self, frames: Mapping[int, TrackedFrame]) -> dict[int, TrackedFrame]:
        """Measure the next motions from the newest frames of some pairs, and add corners to their tracks.

        Images that all repeat are of an earlier instant than their stamp: nothing is measured from them.
        """
        if self._all_frozen:
            return dict(frames)
        newest_ns = max((frame.stamp_ns for frame in frames.values()), default=None)
        for j in frames:
            if newest_ns is not None and newest_ns != self._histories[j].newest_ns:
                self._histories[j].restart(newest_ns)
        replenished = self._in_parallel(lambda j: self._trackers[j].replenish(), frames)
        self._latest.update(replenished)
        self._references.replace(replenished)
        if self._config.motion.reference == "keyframe":
            for j in replenished:
                self._trackers[j].keep_keyframe_patches()
        return replenished

    def _graded_hypotheses(self, seen: Seen, agreement: Agreement) -> list[GradedHypothesis]:
        """Check each motion hypothesis on its own."""
        stereo = stereo_share(seen.reference, seen.frames, self._baselines_m)
        return [
            graded_hypothesis(
                self._with_depth_errors(self._relative_motion(seen, hypothesis.refined), seen, hypothesis.refined),
                seen.frozen.all_since_ns,
                stereo,
                (hypothesis.refined.rms_px() or 0.0) / self._config.motion.pixel_sigma_px,
            )
            for hypothesis in agreement.hypotheses
        ]

    def _relative_motion(self, seen: Seen, refined: Refined) -> RelativeMotion:
        ref_T_cur = se3_inverse(refined.cur_T_ref)
        angle, distance = np.linalg.norm(so3_log(ref_T_cur[:3, :3].copy())), np.linalg.norm(ref_T_cur[:3, 3])
        scaled = np.diag(np.repeat([angle, distance], 3) ** 2 * self._scale_sigma**2)
        used_once = self._config.motion.reference == "previous"  # nothing is shared with another motion
        return RelativeMotion(
            seen.reference_stamp_ns,
            seen.stamp_ns,
            ref_T_cur,
            refined.covariance + scaled,
            np.zeros((6, 6)) if used_once else refined.shared_covariance,
            int(refined.inlier.sum()),
        )

    def _with_depth_errors(self, motion: RelativeMotion, seen: Seen, refined: Refined) -> RelativeMotion:
        """Add the derivatives by errors of the pairs' depths, by which an IMU may contradict the motion."""
        if not self._config.estimates_calibration or self._rig.imu is None:
            return motion
        observations, cur_T_ref = seen.correspondences.observations, np.ascontiguousarray(refined.cur_T_ref)
        derivatives = by_depth_errors(self._extrinsics.arrays, observations, refined.inlier, cur_T_ref)
        return replace(motion, by_depth_errors=derivatives)

    def _own_motions(self, seen: Seen, agreement: Agreement) -> dict[int, RelativeMotion]:
        """Return each pair's own motion without the corrections in force; with one pair alone, that is the rig's."""
        first = agreement.hypotheses[0]
        alone = {first.pairs[0]: first.refined} if len(self._rig.groups) == 1 else {}
        motions = {}
        for j, refined in (agreement.own or alone).items():
            if j >= len(self._rig.pairs):
                continue
            motions[j] = self._relative_motion(seen, self._extrinsics.uncorrected(j, refined))
        return motions

    def _move_trackers(self) -> None:
        """Give the single cameras' trackers the poses by which they locate points."""
        for j in range(len(self._rig.pairs), len(self._rig.groups)):
            self._trackers[j].move(self._extrinsics.arrays.body_T_left[j])


def _baselines_m(rig: Rig) -> list[float]:
    """Return the baseline of each group of cameras, 0 for a single camera."""
    return [pair.baseline_m for pair in rig.pairs] + [0.0] * len(rig.singles)
