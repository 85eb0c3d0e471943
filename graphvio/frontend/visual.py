"""The visual front-end as the odometry uses it: framesets in, relative poses of the rig with covariance out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.config import Config
from graphvio.frontend.agreement import Agreement, Side, agree, is_supported
from graphvio.frontend.alignment import Misalignment, PairAlignment
from graphvio.frontend.frozen import FrozenImages
from graphvio.frontend.images import checked
from graphvio.frontend.observations import Correspondences, RigArrays, correspond
from graphvio.frontend.quality import doubted, graded, stereo_share
from graphvio.frontend.references import References
from graphvio.frontend.refinement import Refined
from graphvio.frontend.selection import best_pair_motion, joint_motion
from graphvio.frontend.standstill import Standstill
from graphvio.frontend.stopwatch import Stopwatch
from graphvio.frontend.tracker import PairTracker
from graphvio.frontend.tracks import PairFrame
from graphvio.geometry import se3_adjoint, se3_inverse, so3_log
from graphvio.measurements.motion import PairReport, Quality, RelativeMotion, VisualResult
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig

MotionPredictor = Callable[[int], Float | None]
"""Takes an earlier stamp and returns the predicted ``cur_T_then`` (4, 4) of body, or None if unknown."""

_DOUBT_NS = 1_000_000_000
_ABSENT_NS = 1_000_000_000  # after such an absence a pair starts anew


class VisualFrontend:
    """Tracks every pair and estimates the rig's motion since a reference frameset."""

    def __init__(self, rig: Rig, config: Config) -> None:
        self._config = config
        self._rig = rig
        self._arrays = RigArrays.of(rig)  # with the corrections that are in force
        self._trackers = [PairTracker(pair, config) for pair in rig.pairs]
        self._baselines_m = [pair.baseline_m for pair in rig.pairs]
        self._frozen = FrozenImages()
        self._latest: dict[int, PairFrame] = {}
        self._references = References(config.motion)
        # Focal lengths and baselines that are a little wrong scale all motions alike. No residual shows that, and an
        # IMU must not be corrected by it; without one nothing tells the scale, and as noise it would only be smoothed.
        self._scale_sigma = 0.0 if rig.imu is None else config.motion.calibration_error_share
        self._standstill = Standstill()
        self._all_frozen = False
        self._alignments = {j: PairAlignment() for j in range(1, len(rig.pairs))}
        self._contradicted_ns: int | None = None  # when the pairs last were beyond 5 sigma of each other
        self._workers = ThreadPoolExecutor(len(rig.pairs), thread_name_prefix="graphvio-pair")
        if len(rig.pairs) > 1:
            cv2.setNumThreads(1)  # pairs run side by side; OpenCV's own threads would only compete with them

    @property
    def reference_stamps_ns(self) -> frozenset[int]:
        """Stamps of the framesets that later motions will be measured from."""
        return self._references.stamps_ns

    @property
    def body_T_left(self) -> Float:
        """(P, 4, 4) of the pairs' left cameras, with the corrections that are in force."""
        return self._arrays.body_T_left

    def frames_at(self, stamp_ns: int) -> dict[int, PairFrame]:
        """What the pairs saw at the newest frameset, if it is of this stamp."""
        return {j: frame for j, frame in self._latest.items() if frame.stamp_ns == stamp_ns}

    def limit_corners(self, share: float) -> None:
        """From now on follow only a share, above 0 and up to 1, of the corners that the configuration asks for."""
        for tracker in self._trackers:
            tracker.limit_corners(share)

    @property
    def misaligned(self) -> Mapping[int, Misalignment]:
        """Pairs whose place relative to the first pair is not what the rig says: motions allow for it."""
        return {j: alignment.in_force for j, alignment in self._alignments.items() if alignment.in_force is not None}

    def process(self, frameset: FrameSet, predict: MotionPredictor) -> VisualResult:
        """Measure the motion of a frameset.

        Args:
            frameset: images of any subset of pairs.
            predict: the back-end's prediction, which starts the search.

        Raises:
            RigError: if an image is not what the rig says; nothing has changed then.
        """
        watch = Stopwatch()
        frameset = checked(frameset, self._rig)
        stamp_ns = frameset.stamp_ns
        frozen = self._frozen.look(frameset)
        self._all_frozen = frozen.all_since_ns is not None
        frames = self._observe(frameset, frozen.pairs, predict)
        watch.lap("track")
        for stage in ("pyramid", "register", "flow", "stereo"):
            watch.stage_ms[stage] = max((frame.stage_ms[stage] for frame in frames.values()), default=0.0)
        reference = self._references.shared(frames)
        if not reference:
            reports = {j: _report(frame) for j, frame in self._refer_to(frames).items()}
            watch.lap("renew")
            reason = frozen.reason if self._all_frozen or not frames else "first images"
            return VisualResult(None, Quality.FAILED, reason, reports, frozen=frozen.pairs, stage_ms=watch.stage_ms)
        reference_stamp_ns = next(iter(reference.values())).stamp_ns
        correspondences = correspond(reference, frames)
        predicted = predict(reference_stamp_ns)
        agreement, reason = self._estimate(correspondences, predicted, stamp_ns)
        watch.lap("motion")
        reports = {j: _report(frame, correspondences, j, agreement) for j, frame in frames.items()}
        if agreement is None:
            reports = _with_rejections(reports, self._refer_to(frames))
            watch.lap("renew")
            return VisualResult(None, Quality.FAILED, reason, reports, frozen=frozen.pairs, stage_ms=watch.stage_ms)
        refined = agreement.sides[0].refined
        stereo = stereo_share(reference, frames, self._baselines_m)
        sides = [
            doubted(
                self._motion(reference_stamp_ns, stamp_ns, side.refined),
                frozen.all_since_ns,
                stereo,
                (side.refined.rms_px() or 0.0) / self._config.motion.pixel_sigma_px,
            )
            for side in agreement.sides
        ]
        motion, quality, reason = graded(sides, agreement.tension)
        resting = self._standstill.look(frames, correspondences.identities(frames, refined.inlier))
        self._drop_outliers(frames, correspondences, agreement)
        watch.lap("judge")
        own: dict[int, RelativeMotion] = {}
        if self._references.are_spent(frames, correspondences, refined, len(agreement.sides) > 1):
            own = self._own_motions(reference_stamp_ns, stamp_ns, agreement)
            self._learn_alignments(agreement)
            reports = _with_rejections(reports, self._refer_to(frames))
        watch.lap("renew")
        return VisualResult(
            motion,
            quality,
            reason,
            reports,
            alternatives=tuple(side.motion for side in sides) if len(sides) > 1 else (),
            own=own,
            is_stationary=resting,
            frozen=frozen.pairs,
            stage_ms=watch.stage_ms,
        )

    def start_keyframe(self) -> None:
        """Measure the next motions from the newest frameset."""
        self._references.clear()
        if not self._latest:
            return  # no image has come yet
        newest_ns = max(frame.stamp_ns for frame in self._latest.values())
        self._refer_to({j: frame for j, frame in self._latest.items() if frame.stamp_ns == newest_ns})

    def close(self) -> None:
        """End the threads."""
        self._workers.shutdown()

    def _observe(self, frameset: FrameSet, left_out: frozenset[int], predict: MotionPredictor) -> dict[int, PairFrame]:
        for j in [j for j, frame in self._latest.items() if frameset.stamp_ns - frame.stamp_ns > _ABSENT_NS]:
            self._trackers[j].drop(self._latest.pop(j).ids)
            self._references.forget(j)

        def observe(j: int) -> PairFrame:
            left, right = frameset.images[j]
            since_latest = self._predicted(j, self._latest.get(j), predict)
            since_reference = self._predicted(j, self._references.of(j), predict)
            return self._trackers[j].observe(frameset.stamp_ns, left, right, since_latest, since_reference)

        frames = self._side_by_side(observe, frameset.images.keys() - left_out)
        self._latest.update(frames)
        return frames

    def _side_by_side(self, work: Callable[[int], PairFrame], pairs: Iterable[int]) -> dict[int, PairFrame]:
        """Work on each pair, all but the first in threads of their own."""
        ordered = sorted(pairs)
        others = [(j, self._workers.submit(work, j)) for j in ordered[1:]]
        frames = {j: work(j) for j in ordered[:1]}
        return frames | {j: other.result() for j, other in others}

    def _predicted(self, pair: int, then: PairFrame | None, predict: MotionPredictor) -> Float | None:
        """Predicted motion of points in a pair's left camera since one of its frames, by eq. (1)."""
        cur_T_then = None if then is None else predict(then.stamp_ns)
        if cur_T_then is None:
            return None
        body_T_left = self._arrays.body_T_left[pair]
        return np.asarray(se3_inverse(body_T_left) @ cur_T_then @ body_T_left)

    def _refer_to(self, frames: Mapping[int, PairFrame]) -> dict[int, PairFrame]:
        """Measure the next motions from these frames, the newest of their pairs, with new corners beside the tracks.

        Images that all repeat are of an earlier instant than their stamp: nothing is measured from them.
        """
        if self._all_frozen:
            return dict(frames)
        renewed = self._side_by_side(lambda j: self._trackers[j].replenish(), frames)
        self._latest.update(renewed)
        self._references.replace(renewed)
        if self._config.motion.reference == "keyframe":
            for j in renewed:
                self._trackers[j].keep_keyframe_patches()
        return renewed

    def _estimate(
        self, correspondences: Correspondences, predicted: Float | None, stamp_ns: int
    ) -> tuple[Agreement | None, str]:
        config, observations = self._config.motion, correspondences.observations
        if len(observations.pair) < config.min_inliers:
            return None, f"only {len(observations.pair)} points in view"
        rng = np.random.default_rng([config.seed, stamp_ns % 2**63])
        start = np.eye(4) if predicted is None else predicted
        if config.selection == "joint":
            refined = joint_motion(self._arrays, observations, start, config, rng)
            agreement = agree(
                self._arrays,
                observations,
                refined,
                config,
                rng,
                self.misaligned,
                self._in_doubt(stamp_ns),
            )
            if agreement.contradicts:
                self._contradicted_ns = stamp_ns
        else:
            refined = best_pair_motion(self._arrays, observations, start, config, rng)
            agreement = Agreement((Side(observations.pairs, refined),), {})
        best = agreement.sides[0]
        rows = np.isin(observations.pair, best.pairs)
        if not is_supported(best.refined.inlier[rows], config):
            return None, f"the best motion explains only {best.support} of {int(rows.sum())} points"
        return agreement, ""

    def _in_doubt(self, stamp_ns: int) -> bool:
        """Whether the pairs contradicted each other a moment ago."""
        return self._contradicted_ns is not None and 0 <= stamp_ns - self._contradicted_ns < _DOUBT_NS

    def _motion(self, reference_stamp_ns: int, stamp_ns: int, refined: Refined) -> RelativeMotion:
        ref_T_cur = se3_inverse(refined.cur_T_ref)
        angle, distance = np.linalg.norm(so3_log(ref_T_cur[:3, :3].copy())), np.linalg.norm(ref_T_cur[:3, 3])
        scaled = np.diag(np.repeat([angle, distance], 3) ** 2 * self._scale_sigma**2)
        used_once = self._config.motion.reference == "previous"  # nothing is shared with another motion
        return RelativeMotion(
            reference_stamp_ns,
            stamp_ns,
            ref_T_cur,
            refined.covariance + scaled,
            np.zeros((6, 6)) if used_once else refined.shared_covariance,
            int(refined.inlier.sum()),
        )

    def _own_motions(self, reference_stamp_ns: int, stamp_ns: int, agreement: Agreement) -> dict[int, RelativeMotion]:
        """What each pair alone says, without the corrections in force; a single pair's is what all say."""
        alone = {agreement.sides[0].pairs[0]: agreement.sides[0].refined} if len(self._rig.pairs) == 1 else {}
        made = {}
        for j, refined in (agreement.own or alone).items():
            back = se3_inverse(self._alignments[j].correction) if j in self._alignments else np.eye(4)
            adjoint = se3_adjoint(back)
            uncorrected = replace(
                refined,
                cur_T_ref=back @ refined.cur_T_ref @ se3_inverse(back),
                covariance=adjoint @ refined.covariance @ adjoint.T,
            )
            made[j] = self._motion(reference_stamp_ns, stamp_ns, uncorrected)
        return made

    def _drop_outliers(
        self, frames: Mapping[int, PairFrame], correspondences: Correspondences, agreement: Agreement
    ) -> None:
        """Forget tracks that their pair's motion does not explain."""
        for j, rows in correspondences.rows.items():
            inlier = _inliers_of(j, correspondences, agreement)
            self._trackers[j].drop(frames[j].ids[rows[~inlier]])

    def _learn_alignments(self, agreement: Agreement) -> None:
        """At the end of a keyframe, compare the pairs' motions over it with the first pair's."""
        own = agreement.own
        if 0 not in own:
            return
        for j, alignment in self._alignments.items():
            if j not in own:
                continue
            alignment.add(own[0], own[j])
            if alignment.learn():
                self._arrays = self._arrays.corrected(RigArrays.of(self._rig), j, alignment.correction)


def _with_rejections(reports: Mapping[int, PairReport], renewed: Mapping[int, PairFrame]) -> dict[int, PairReport]:
    """Reports with what the search for new corners threw out, too."""
    return {j: replace(report, rejected=renewed[j].rejected) for j, report in reports.items()}


def _inliers_of(pair: int, correspondences: Correspondences, agreement: Agreement) -> Bool:
    """Which of a pair's points are right: by its own motion, if it has one."""
    if pair in agreement.own:
        return agreement.own[pair].inlier
    return np.asarray(agreement.sides[0].refined.inlier[correspondences.observations.pair == pair])


def _report(
    frame: PairFrame, correspondences: Correspondences | None = None, pair: int = 0, agreement: Agreement | None = None
) -> PairReport:
    is_inlier = np.zeros(len(frame.ids), dtype=bool)
    report = PairReport(0, 0, frame.pixels, is_inlier, frame.ages, frame.rejected)
    if correspondences is None or pair not in correspondences.rows:
        return report
    rows = correspondences.rows[pair]
    report = replace(report, points=len(rows))
    if agreement is None:
        return report
    of_pair, chosen = correspondences.observations.pair == pair, agreement.sides[0].refined
    is_inlier[rows] = chosen.inlier[of_pair]
    own = agreement.own.get(pair)
    return replace(
        report,
        inliers=int(is_inlier.sum()),
        is_inlier=is_inlier,
        rms_px=chosen.rms_px(of_pair),
        own_inliers=None if own is None else int(own.inlier.sum()),
        own_rms_px=None if own is None else own.rms_px(),
    )
