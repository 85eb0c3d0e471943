"""Each stereo pair's own visual odometry, blind to the others and to where the rig file puts them (section 4)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from graphvio.calibration.camera_motions import CameraMotions
from graphvio.config import Config
from graphvio.frontend.steady_motion import SteadyMotion
from graphvio.frontend.visual import VisualFrontend
from graphvio.measurements.motion import Quality, RelativeMotion
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig


class SeparateMotions:
    """Runs a front-end for every pair of a rig.

    Args:
        rig: of the framesets; of its extrinsics only those within a pair matter.
        config: of the front-ends.
    """

    def __init__(self, rig: Rig, config: Config) -> None:
        self._rig = rig
        self._pairs = [_Pair(rig.with_pairs([j]).without_imu(), config) for j in range(len(rig.pairs))]
        self._workers = ThreadPoolExecutor(len(rig.pairs), thread_name_prefix="graphvio-calibration")

    def add(self, frameset: FrameSet) -> None:
        """Work on the next frameset, all pairs side by side."""
        list(self._workers.map(lambda j: self._pairs[j].add(j, frameset), sorted(frameset.images)))

    def motions(self) -> list[CameraMotions]:
        """For each pair, what it has told of its left camera's motion until now."""
        pairs = zip(self._pairs, self._rig.pairs, strict=True)
        return [CameraMotions(each.stamps_ns, each.motions, pair.left.body_T_cam) for each, pair in pairs]

    def close(self) -> None:
        """End all threads."""
        for each in self._pairs:
            each.frontend.close()
        self._workers.shutdown()


class _Pair:
    def __init__(self, rig: Rig, config: Config) -> None:
        self.frontend = VisualFrontend(rig, config)
        self.stamps_ns: list[int] = []
        self.motions: list[RelativeMotion] = []
        self._steady = SteadyMotion()

    def add(self, number: int, frameset: FrameSet) -> None:
        alone = FrameSet(frameset.stamp_ns, {0: frameset.images[number]})
        self._steady.begin(alone.stamp_ns)
        result = self.frontend.process(alone, self._steady.predict)
        motion = result.motion if result.quality is Quality.GOOD else None
        self._steady.end(motion)
        self.stamps_ns.append(alone.stamp_ns)
        if motion is not None:
            self.motions.append(motion)
