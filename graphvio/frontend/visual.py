"""The visual front-end as the odometry uses it: framesets in, relative poses of the rig with covariance out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from time import perf_counter

import cv2
import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.events import FrameSet, PairReport
from graphvio.frontend.observations import Correspondences, RigArrays, correspond
from graphvio.frontend.refinement import Refined
from graphvio.frontend.selection import best_pair_motion, joint_motion
from graphvio.frontend.tracker import PairTracker
from graphvio.frontend.tracks import PairFrame
from graphvio.geometry import se3_inverse
from graphvio.rig import Rig

MotionPredictor = Callable[[int], Float | None]
"""Takes an earlier stamp and returns the predicted ``cur_T_then`` (4, 4) of body, or None if unknown."""

_MIN_KEYFRAME_POINTS = 20


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """A measured motion of the rig.

    Attributes:
        reference_stamp_ns: the earlier instant.
        stamp_ns: the later one.
        reference_T_current: (4, 4) of body: the motion that a between factor takes.
        covariance: (6, 6), tangent ``[rotation, translation]`` in the body frame of the later instant.
        inliers: number of points that it explains.
    """

    reference_stamp_ns: int
    stamp_ns: int
    reference_T_current: Float
    covariance: Float
    inliers: int


@dataclass(frozen=True, eq=False)
class VisualResult:
    """What the front-end made of one frameset.

    Attributes:
        motion: the measured motion, or None.
        reason: why there is none, or empty.
        pairs: pair index -> report.
        stage_ms: time by stage.
    """

    motion: RelativeMotion | None
    reason: str
    pairs: Mapping[int, PairReport]
    stage_ms: Mapping[str, float]


class VisualFrontend:
    """Tracks every pair and estimates the rig's motion since a reference frameset."""

    def __init__(self, rig: Rig, config: Config) -> None:
        self._config = config
        self._arrays = RigArrays.of(rig)
        self._trackers = [PairTracker(pair, config) for pair in rig.pairs]
        self._latest: dict[int, PairFrame] = {}
        self._references: dict[int, PairFrame] = {}
        self._workers = ThreadPoolExecutor(len(rig.pairs), thread_name_prefix="graphvio-pair")
        if len(rig.pairs) > 1:
            cv2.setNumThreads(1)  # pairs run side by side; OpenCV's own threads would only compete with them

    @property
    def reference_stamps_ns(self) -> frozenset[int]:
        """Stamps of the framesets that later motions will be measured from."""
        return frozenset(frame.stamp_ns for frame in self._references.values())

    def process(self, frameset: FrameSet, predict: MotionPredictor) -> VisualResult:
        """Measure the motion of a frameset.

        Args:
            frameset: images of any subset of pairs.
            predict: the back-end's prediction, which starts the search.
        """
        start = perf_counter()
        frames = self._observe(frameset, predict)
        tracked = perf_counter()
        reference = self._shared_reference(frames)
        if not reference:
            self._refer_to(frames)
            reports = {j: _report(frame, None, None) for j, frame in frames.items()}
            return VisualResult(None, "first images", reports, {"track": 1e3 * (tracked - start)})
        reference_stamp_ns = next(iter(reference.values())).stamp_ns
        correspondences = correspond(reference, frames)
        refined, reason = self._estimate(correspondences, predict(reference_stamp_ns), frameset.stamp_ns)
        if refined is None or self._reference_is_spent(frames, correspondences, refined):
            self._refer_to(frames)
        if refined is not None:
            self._drop_outliers(frames, correspondences, refined)
        reports = {j: _report(frame, correspondences, refined, j) for j, frame in frames.items()}
        stage_ms = {"track": 1e3 * (tracked - start), "motion": 1e3 * (perf_counter() - tracked)}
        if refined is None:
            return VisualResult(None, reason, reports, stage_ms)
        motion = RelativeMotion(
            reference_stamp_ns,
            frameset.stamp_ns,
            se3_inverse(refined.cur_T_ref),
            refined.covariance,
            int(refined.inlier.sum()),
        )
        return VisualResult(motion, "", reports, stage_ms)

    def rekey(self) -> None:
        """Measure the next motions from the newest frames."""
        newest_ns = max(frame.stamp_ns for frame in self._latest.values())
        self._references.clear()
        self._refer_to({j: frame for j, frame in self._latest.items() if frame.stamp_ns == newest_ns})

    def close(self) -> None:
        """End the threads."""
        self._workers.shutdown()

    def _observe(self, frameset: FrameSet, predict: MotionPredictor) -> dict[int, PairFrame]:
        def observe(j: int) -> PairFrame:
            left, right = frameset.images[j]
            since_latest = self._predicted(j, self._latest.get(j), predict)
            since_reference = self._predicted(j, self._references.get(j), predict)
            return self._trackers[j].observe(frameset.stamp_ns, left, right, since_latest, since_reference)

        pairs = sorted(frameset.images)
        frames = dict(zip(pairs, self._workers.map(observe, pairs), strict=True))
        self._latest.update(frames)
        return frames

    def _predicted(self, pair: int, then: PairFrame | None, predict: MotionPredictor) -> Float | None:
        """Predicted motion of points in a pair's left camera since one of its frames, by eq. (1)."""
        cur_T_then = None if then is None else predict(then.stamp_ns)
        if cur_T_then is None:
            return None
        body_T_left = self._arrays.body_T_left[pair]
        return np.asarray(se3_inverse(body_T_left) @ cur_T_then @ body_T_left)

    def _refer_to(self, frames: Mapping[int, PairFrame]) -> None:
        """Measure the next motions from these frames, the newest of their pairs."""
        self._references.update(frames)
        if self._config.motion.reference == "keyframe":
            for j in frames:
                self._trackers[j].anchor()

    def _shared_reference(self, frames: Mapping[int, PairFrame]) -> dict[int, PairFrame]:
        """Reference frames of one instant: where pairs were keyed at different times, the larger group counts."""
        groups: dict[int, dict[int, PairFrame]] = {}
        for j in frames:
            if j in self._references:
                groups.setdefault(self._references[j].stamp_ns, {})[j] = self._references[j]
        return max(groups.values(), key=len, default={})

    def _estimate(
        self, correspondences: Correspondences, predicted: Float | None, stamp_ns: int
    ) -> tuple[Refined | None, str]:
        config = self._config.motion
        observations = correspondences.observations
        if len(observations.pair) < config.min_inliers:
            return None, f"only {len(observations.pair)} points in view"
        rng = np.random.default_rng([config.seed, stamp_ns % 2**63])
        solve = joint_motion if config.selection == "joint" else best_pair_motion
        refined = solve(self._arrays, observations, np.eye(4) if predicted is None else predicted, config, rng)
        inliers = int(refined.inlier.sum())
        if inliers < config.min_inliers or inliers < config.min_inlier_share * len(observations.pair):
            return None, f"the best motion explains only {inliers} of {len(observations.pair)} points"
        return refined, ""

    def _reference_is_spent(
        self, frames: Mapping[int, PairFrame], correspondences: Correspondences, refined: Refined
    ) -> bool:
        if self._config.motion.reference == "previous":
            return True
        if any(j not in correspondences.rows for j in frames):
            return True  # a pair that came back takes part again from the next frameset on
        pair, overlap = correspondences.observations.pair, self._config.motion.keyframe_overlap
        explained = int(refined.inlier.sum())
        if explained < overlap * correspondences.offered or explained < _MIN_KEYFRAME_POINTS:
            return True
        for (
            j,
            frame,
        ) in frames.items():  # one pair's keyframe may be spent long before all points together are few
            if np.sum(refined.inlier[pair == j]) < 0.5 * overlap * frame.has_depth.sum():
                return True
        return False

    def _drop_outliers(
        self, frames: Mapping[int, PairFrame], correspondences: Correspondences, refined: Refined
    ) -> None:
        pair = correspondences.observations.pair
        for j, rows in correspondences.rows.items():
            self._trackers[j].drop(frames[j].ids[rows[~refined.inlier[pair == j]]])


def _report(
    frame: PairFrame, correspondences: Correspondences | None, refined: Refined | None, pair: int = 0
) -> PairReport:
    is_inlier = np.zeros(len(frame.ids), dtype=bool)
    points = 0
    if correspondences is not None and pair in correspondences.rows:
        rows = correspondences.rows[pair]
        points = len(rows)
        if refined is not None:
            is_inlier[rows] = refined.inlier[correspondences.observations.pair == pair]
    return PairReport(points, int(is_inlier.sum()), frame.pixels, is_inlier)
