"""Reference framesets, from which motion is measured: the previous one, or a keyframe while enough of it is in view."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphvio.arrays import Bool, Int
from graphvio.config.stages import MotionConfig
from graphvio.frontend.depth.tracks import TrackedFrame, common_rows
from graphvio.frontend.motion.observations import Correspondences
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion, as_at_stamp
from graphvio.rig import Rig

_T = THRESHOLDS.reference


class References:
    """Holds each pair's reference frame, and decides when it is replaced."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._frames: dict[int, TrackedFrame] = {}

    @property
    def stamps_ns(self) -> frozenset[int]:
        """Stamps of the framesets that later motions will be measured from."""
        return frozenset(frame.stamp_ns for frame in self._frames.values())

    def of(self, pair: int) -> TrackedFrame | None:
        """Return a pair's reference frame, or None."""
        return self._frames.get(pair)

    def replace(self, frames: Mapping[int, TrackedFrame]) -> None:
        """Set the reference frames of some pairs: pair index -> tracks."""
        self._frames.update(frames)

    def recalibrate(self, rig: Rig) -> None:
        """Take another calibration of the rig, and triangulate the references' points again."""
        self._frames = {j: frame.recalibrated(rig.groups[j]) for j, frame in self._frames.items()}

    def read_out(self, stamp_ns: int, readout: ReadoutMotion, rig: Rig) -> None:
        """Compensate the rolling shutters of the references that have a stamp by another motion of body."""
        for j, frame in self._frames.items():
            if frame.stamp_ns == stamp_ns and rig.groups[j].left.line_time_us:
                self._frames[j] = as_at_stamp(frame, rig.groups[j], readout)

    def clear(self) -> None:
        """Forget the references of all pairs."""
        self._frames.clear()

    def forget(self, pair: int) -> None:
        """Forget a pair's reference."""
        self._frames.pop(pair, None)

    def shared(self, frames: Mapping[int, TrackedFrame]) -> dict[int, TrackedFrame]:
        """Return the pairs' reference frames of one stamp: if they differ, the one with the most tracks in common."""
        groups: dict[int, dict[int, TrackedFrame]] = {}
        for j in frames:
            if j in self._frames:
                groups.setdefault(self._frames[j].stamp_ns, {})[j] = self._frames[j]
        if len(groups) < 2:
            return next(iter(groups.values()), {})

        def in_view(stamp_ns: int) -> int:
            return sum(len(common_rows(frame.ids, frames[j].ids)[0]) for j, frame in groups[stamp_ns].items())

        return groups[max(groups, key=lambda stamp_ns: (in_view(stamp_ns), stamp_ns))]

    def must_be_replaced(
        self, frames: Mapping[int, TrackedFrame], correspondences: Correspondences, inlier: Bool
    ) -> bool:
        """Decide, after a motion was measured, whether the newest frames have to replace the references.

        Args:
            frames: Newest frame of each pair.
            correspondences: Points that both these frames and the references have.
            inlier: (N,) The points that the motion explains.
        """
        return int(inlier.sum()) < _T.min_points or self._have_lost_points(frames, correspondences, inlier)

    def must_be_replaced_after_few(
        self, frames: Mapping[int, TrackedFrame], correspondences: Correspondences, inlier: Bool
    ) -> bool:
        """Decide the same after a frameset with too few points for a motion.

        The keyframe goes on while its points are in view and the newest frames do not have enough points with depth for
        a motion either.

        Args:
            frames: Newest frame of each pair.
            correspondences: Points that both these frames and the references have.
            inlier: (N,) The points that agree with the prediction.
        """
        newest = sum(int(frame.has_depth.sum()) for frame in frames.values())
        return newest >= self._config.min_inliers or self._have_lost_points(frames, correspondences, inlier)

    def _have_lost_points(
        self, frames: Mapping[int, TrackedFrame], correspondences: Correspondences, inlier: Bool
    ) -> bool:
        """Return whether too few of the references' points are still seen, by their number then or in the new frames.

        With the previous frameset as reference, the answer is always True. A pair none of whose points the motion
        explains, such as one with a crowd in front of it, does not end the keyframe of the others.
        """
        if self._config.reference == "previous":
            return True
        if any(j not in correspondences.rows for j in frames):
            return True  # a pair that came back takes part again from the next frameset on
        pair, overlap = correspondences.observations.pair, self._config.keyframe_overlap
        explained = {int(j) for j in np.flatnonzero(np.bincount(pair[inlier]))}
        support, candidates = int(inlier.sum()), sum(correspondences.candidates[j] for j in explained)
        if support < overlap * candidates:
            return True
        seen = correspondences.identities(frames, inlier)
        if self._share_of_near_points({j: seen[j] for j in explained}) < _T.min_near_share * overlap:
            return True
        # One pair may have lost its points long before all points together are few.
        for j, frame in frames.items():
            usable = inlier[pair == j] if j in explained else pair == j
            if usable.sum() < _T.min_pair_share * overlap * frame.has_depth.sum():
                return True
        return False

    def _share_of_near_points(self, seen: Mapping[int, Int]) -> float:
        """Return the share of the references' near points that are among those still seen (pair index -> identities).

        Far points stay in view for long, but do not constrain the translation.
        """
        candidates = still = 0
        for j, ids in seen.items():
            near = self._frames[j].constrains_translation(self._config.pixel_sigma_px)
            candidates += int(near.sum())
            still += int(near[common_rows(self._frames[j].ids, ids)[0]].sum())
        return still / candidates if candidates else 1.0
