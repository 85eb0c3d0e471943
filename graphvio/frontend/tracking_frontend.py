"""Base class of the front-ends: it tracks every pair and single camera, and keeps the reference frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.config import Config
from graphvio.frontend.depth.motion_stereo import MotionHistory
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.imaging.frozen import Frozen, FrozenImages
from graphvio.frontend.imaging.images import ImageMask, checked
from graphvio.frontend.motion.observations import Correspondences, correspond
from graphvio.frontend.pairs.extrinsic_monitor import ExtrinsicError
from graphvio.frontend.pairs.extrinsics import RigExtrinsics
from graphvio.frontend.references import References
from graphvio.frontend.thresholds import THRESHOLDS
from graphvio.frontend.tracking.rolling_shutter import ReadoutMotion
from graphvio.frontend.tracking.standstill import Standstill
from graphvio.frontend.tracking.tracker import GroupTracker
from graphvio.geometry import se3_inverse
from graphvio.measurements.motion import VisualResult
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig
from graphvio.runtime import usable_cores
from graphvio.timing import timed

MotionPredictor = Callable[[int], Float | None]
"""Takes an earlier stamp and returns the predicted ``cur_T_then`` (4, 4) of body, or None if unknown."""

_Result = TypeVar("_Result")


class TrackedFrameset(NamedTuple):
    """Tracks of a frameset, and of the reference from which its motion is measured.

    Attributes:
        stamp_ns: Stamp of the frameset.
        frozen: Which images repeat the ones before.
        frames: Pair index -> its tracks in this frameset.
        reference: Pair index -> its tracks at the reference; empty if there is no reference.
        correspondences: Points that have tracks both in this frameset and at the reference.
        readout: Motion of body by which rolling shutters are compensated; None if it is unknown or there are none.
    """

    stamp_ns: int
    frozen: Frozen
    frames: dict[int, TrackedFrame]
    reference: dict[int, TrackedFrame]
    correspondences: Correspondences
    readout: ReadoutMotion | None

    @property
    def reference_stamp_ns(self) -> int:
        """Stamp of the reference; there has to be one."""
        return next(iter(self.reference.values())).stamp_ns


class TrackingFrontend(ABC):
    """Tracks every pair and single camera, in several threads: at most one fewer than there are cores.

    Args:
        rig: Stereo pairs and single cameras.
        config: Configuration of all stages.
        image_mask: Function that makes a mask for each image, or None.

    Attributes:
        stage_ms: Processing time by stage of the newest frameset, milliseconds.
    """

    def __init__(self, rig: Rig, config: Config, image_mask: ImageMask | None = None) -> None:
        self.stage_ms: dict[str, float] = {}
        self._config = config
        self._rig = rig
        self._extrinsics = RigExtrinsics(rig, config)
        self._histories = [MotionHistory() for _ in rig.groups]  # one each: groups may be triggered separately
        self._trackers = [
            GroupTracker(group, config, history, image_mask)
            for group, history in zip(rig.groups, self._histories, strict=True)
        ]
        self._frozen = FrozenImages()
        self._all_frozen = False
        self._latest: dict[int, TrackedFrame] = {}
        self._references = References(config.motion)
        self._standstill = Standstill()
        self._has_rolling_shutter = any(camera.line_time_us for camera in rig.cameras)
        # One core is left for other work, such as decoding images. Threads that share a core wait for each other.
        self._n_threads = max(1, min(len(rig.groups), usable_cores() - 1))
        self._workers = ThreadPoolExecutor(self._n_threads, thread_name_prefix="graphvio-pair")

    def process(
        self,
        frameset: FrameSet,
        motion_since: MotionPredictor,
        readout: ReadoutMotion | None = None,
        rotation_since: MotionPredictor | None = None,
    ) -> VisualResult:
        """Track a frameset, and measure its motion where the cameras alone can.

        Args:
            frameset: Images of any subset of pairs and single cameras.
            motion_since: The back-end's predicted motion since an earlier stamp, from which the search begins.
            readout: Motion of body while rolling shutters read the images out; if None, the predicted motion is taken
                to continue.
            rotation_since: The rotation since an earlier stamp by the gyro alone, from which the search begins where no
                motion is predicted.

        Raises:
            RigError: If an image does not fit the rig; nothing has changed then.
        """
        self.stage_ms = {}
        seen = self._track(checked(frameset, self._rig), motion_since, readout, rotation_since)
        return self._measure(seen, motion_since)

    @abstractmethod
    def _measure(self, seen: TrackedFrameset, motion_since: MotionPredictor) -> VisualResult:
        """Return the result for the tracks of a frameset, and begin a keyframe if one is due."""

    @property
    def reference_stamps_ns(self) -> frozenset[int]:
        """Stamps of the framesets that later motions will be measured from."""
        return self._references.stamps_ns

    @property
    def body_T_left(self) -> Float:
        """(P, 4, 4) poses of the groups' left cameras in body, with the corrections that are in force."""
        return self._extrinsics.arrays.body_T_left

    @property
    def extrinsic_errors(self) -> Mapping[int, ExtrinsicError]:
        """Errors of the extrinsics relative to the first pair, by group index; motions are corrected for them."""
        return self._extrinsics.extrinsic_errors

    def frames_at(self, stamp_ns: int) -> dict[int, TrackedFrame]:
        """Return the tracks of pairs and single cameras at the newest frameset, if it has this stamp."""
        return {j: frame for j, frame in self._latest.items() if frame.stamp_ns == stamp_ns}

    def limit_corners(self, share: float) -> None:
        """Reduce the corners from now on to a share, above 0 and up to 1, of those that the configuration asks for."""
        for tracker in self._trackers:
            tracker.limit_corners(share)

    def start_keyframe(self) -> None:
        """Make the newest frameset a keyframe, from which the next motions are measured."""
        self._references.clear()
        if not self._latest:
            return  # no image has come yet
        newest_ns = max(frame.stamp_ns for frame in self._latest.values())
        self._refer_to({j: frame for j, frame in self._latest.items() if frame.stamp_ns == newest_ns})

    def drop(self, outliers: Mapping[int, Int]) -> None:
        """Drop the tracks of points that move in the world: index of the pair or single camera -> identities."""
        for j, ids in outliers.items():
            self._trackers[j].drop(ids)

    def close(self) -> None:
        """Stop the worker threads."""
        self._workers.shutdown()

    def _recalibrate(self, rig: Rig, epipolar_margin_px: float, uncertain: Mapping[int, Float]) -> None:
        """Use another calibration from now on; for arguments see `VisualFrontend.recalibrate`."""
        self._rig = rig
        self._extrinsics.recalibrate(rig, uncertain)
        for tracker, group in zip(self._trackers, rig.groups, strict=True):
            tracker.recalibrate(group, epipolar_margin_px)
        self._move_trackers()
        self._references.recalibrate(rig)
        self._latest = {j: frame.recalibrated(rig.groups[j]) for j, frame in self._latest.items()}

    def _move_trackers(self) -> None:
        """Pass the poses of the single cameras to their trackers, which compute depths with them."""
        for j in range(len(self._rig.pairs), len(self._rig.groups)):
            self._trackers[j].move(self._extrinsics.arrays.body_T_left[j])

    @timed("track")
    def _track(
        self,
        frameset: FrameSet,
        motion_since: MotionPredictor,
        readout: ReadoutMotion | None,
        rotation_since: MotionPredictor | None,
    ) -> TrackedFrameset:
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
        return TrackedFrameset(frameset.stamp_ns, frozen, frames, reference, correspond(reference, frames), readout)

    def _in_parallel(self, work: Callable[[int], _Result], groups: Iterable[int]) -> dict[int, _Result]:
        """Run a function on each pair and single camera, in several threads that each take the next one when free."""
        remaining = iter(sorted(groups))

        def work_on_next() -> dict[int, _Result]:
            return {j: work(j) for j in remaining}

        others = [self._workers.submit(work_on_next) for _ in range(self._n_threads - 1)]
        results = work_on_next()
        for other in others:
            results |= other.result()
        return dict(sorted(results.items()))

    def _predicted(self, pair: int, then: TrackedFrame | None, motion_since: MotionPredictor) -> Float | None:
        """Return the predicted motion (4, 4) of points in a pair's left camera since one of its frames, or None."""
        return None if then is None else self._moved(pair, motion_since(then.stamp_ns))

    def _moved(self, pair: int, cur_T_then: Float | None) -> Float | None:
        """Transfer a motion of body to a pair's left camera, by eq. (1): the motion (4, 4) of points there."""
        if cur_T_then is None:
            return None
        body_T_left = self._extrinsics.arrays.body_T_left[pair]
        return np.asarray(se3_inverse(body_T_left) @ cur_T_then @ body_T_left)

    def _steady_readout(self, stamp_ns: int, motion_since: MotionPredictor) -> ReadoutMotion | None:
        """Return the readout motion that continues the predicted one since the previous images, or None without it."""
        before_ns = max((frame.stamp_ns for frame in self._latest.values()), default=stamp_ns)
        cur_T_before = motion_since(before_ns) if before_ns < stamp_ns else None
        return None if cur_T_before is None else ReadoutMotion.steady(cur_T_before, 1e-9 * (stamp_ns - before_ns))

    def _refer_to(self, frames: Mapping[int, TrackedFrame]) -> dict[int, TrackedFrame]:
        """Make the newest frames of some pairs the references of the next motions, and add new corners to their tracks.

        If all images repeat earlier ones, they show an earlier instant than their stamp says, and become no references.

        Returns:
            Pair index -> tracks, with the new corners.
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
