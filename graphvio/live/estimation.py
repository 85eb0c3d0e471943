"""The odometry stage of a live run: its queues, the skipping of framesets, and the limit on waiting for the IMU.

Front-end and back-end are one stage: the front-end searches for points where the back-end's newest state predicts
them, so that the two cannot work at the same time. The front-end itself has a thread for each pair.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from graphvio.config.stages import LiveConfig
from graphvio.live.figures import Meter
from graphvio.live.load import LoadControl
from graphvio.live.stages import Stage
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.readings import host_ns
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.odometry import Odometry
from graphvio.queues import BoundedQueue, Limit, WhenFull

FRAMESETS = "framesets"
"""The lane of framesets in an inbox; IMU samples are in the default lane."""

Inbox = BoundedQueue[tuple[Measurement, int]]
"""Measurements that wait for the odometry, with the host time of their arrival."""

_WAITING_FRAMESETS = 8
_WAITING_SAMPLES = 50_000  # some minutes: if so many wait, the odometry is dead
_WAITING_RESULTS = 64  # estimates that wait for the outputs
_READ_AHEAD = 2  # framesets and results that wait, if the source waits for its reader: more would only take memory
_KEPT_FRAMESETS = 64  # framesets that are kept until they are estimated
_ROUND_S = 0.05
_START_NS = 500_000_000  # framesets that arrive within this time after the first pose may still be late


@dataclass(frozen=True, slots=True, eq=False)
class _UnderWay:
    """A frameset in the odometry: host time of its arrival, and how long it waited for the odometry."""

    frameset: FrameSet
    arrival_ns: int
    waited_ms: float


def make_inbox(max_framesets: int, is_realtime: bool) -> Inbox:
    """Make the queue in front of the odometry.

    Args:
        max_framesets: maximum number of framesets that may wait.
        is_realtime: whether the oldest frameset is dropped when there is no room, and samples when the odometry is
            dead; otherwise the threads that put them wait.
    """
    if is_realtime:
        framesets = Limit(max_framesets, WhenFull.DROP_OLDEST)
        return BoundedQueue(_WAITING_SAMPLES, WhenFull.DROP_NEWEST, framesets=framesets)
    return BoundedQueue(_WAITING_SAMPLES, WhenFull.WAIT, framesets=Limit(max_framesets, WhenFull.WAIT))


class Estimation:
    """The stage ``odometry``: processes the measurements of an inbox, and delivers estimates.

    Args:
        odometry: the odometry.
        config: the configuration, with the limit of the latency.
        is_realtime: whether the limit applies and measurements without room are dropped; otherwise all wait for the
            odometry.
        meter: counts estimates, skipped framesets and latencies.
        publish: takes each estimate, in this thread.
        report_events: passes on the odometry's events.

    Attributes:
        inbox: measurements that wait for the odometry.
        results: estimates that wait for the outputs, with their images if they are still kept.
        load: decides on the number of corners and on the framesets to skip.
        latest: newest estimate, or None.
    """

    def __init__(
        self,
        odometry: Odometry,
        config: LiveConfig,
        is_realtime: bool,
        meter: Meter,
        publish: Callable[[Estimate], None],
        report_events: Callable[[], None],
    ) -> None:
        self.inbox = make_inbox(_WAITING_FRAMESETS if is_realtime else _READ_AHEAD, is_realtime)
        self.results: BoundedQueue[tuple[Estimate, FrameSet | None]] = (
            BoundedQueue(_WAITING_RESULTS, WhenFull.DROP_NEWEST)
            if is_realtime
            else BoundedQueue(_READ_AHEAD, WhenFull.WAIT)
        )
        self.load = LoadControl(config.max_latency_ms)
        self.latest: Estimate | None = None
        self._odometry = odometry
        self._is_realtime = is_realtime
        self._meter = meter
        self._publish = publish
        self._report_events = report_events
        self._corner_share = 1.0
        self._under_way: OrderedDict[int, _UnderWay] = OrderedDict()  # stamp -> frameset
        self._first_pose_ns: int | None = None  # host time at which it was estimated

    def estimate(self, stage: Stage) -> None:
        """Process measurements until there are no more."""
        while not self.inbox.is_finished:
            item = self.inbox.get(self._patience_s())
            if item is not None:
                with stage.working():
                    self._process(stage, *item)
            elif self._patience_s() == 0.0:
                with stage.working():
                    self._process_held(stage)
        with stage.working():
            for estimate in self._odometry.finish():
                self._deliver(stage, estimate)

    def _process(self, stage: Stage, measurement: Measurement, arrival_ns: int) -> None:
        begin_ns = host_ns()
        if isinstance(measurement, FrameSet):
            waited_ms = 1e-6 * (begin_ns - arrival_ns)
            is_newest = not self.inbox.waiting(FRAMESETS)
            if self._is_limited(arrival_ns) and self.load.must_skip(waited_ms, is_newest):
                self._meter.count("skipped_late")
                return
            self._under_way[measurement.stamp_ns] = _UnderWay(measurement, arrival_ns, waited_ms)
            if len(self._under_way) > _KEPT_FRAMESETS:
                self._under_way.popitem(last=False)
        estimate = self._odometry.process(measurement)
        while estimate is not None:
            self._conclude(stage, estimate, begin_ns)
            stage.progress()
            begin_ns = host_ns()
            estimate = self._odometry.process_due()
        self._report_events()

    def _patience_s(self) -> float:
        """Return how long to wait for measurements before a frameset that is held for IMU samples would be late."""
        held_ns = self._odometry.held_ns
        under_way = None if held_ns is None else self._under_way.get(held_ns)
        if under_way is None or not self._is_limited(under_way.arrival_ns):
            return _ROUND_S
        waited_ms = 1e-6 * (host_ns() - under_way.arrival_ns)
        return min(max(1e-3 * (self.load.patience_ms - waited_ms), 0.0), _ROUND_S)

    def _process_held(self, stage: Stage) -> None:
        """Estimate the oldest held frameset without the IMU samples that have not come, as it can wait no longer."""
        begin_ns = host_ns()
        estimate = self._odometry.process_held()
        if estimate is not None:
            self._meter.count("imu_not_awaited")
            self._conclude(stage, estimate, begin_ns)

    def _conclude(self, stage: Stage, estimate: Estimate, begin_ns: int) -> None:
        """Adapt the load to the time that an estimate took, given the host time at its beginning, and deliver it."""
        self._report_events()
        under_way = self._under_way.get(estimate.stamp_ns)
        if under_way is not None and self._is_limited(under_way.arrival_ns):
            self.load.add(estimate.stamp_ns, under_way.waited_ms, 1e-6 * (host_ns() - begin_ns))
            if self.load.corner_share != self._corner_share:
                self._corner_share = self.load.corner_share
                self._odometry.limit_corners(self._corner_share)
        self._deliver(stage, estimate)

    def _deliver(self, stage: Stage, estimate: Estimate) -> None:
        under_way, now_ns = self._under_way.pop(estimate.stamp_ns, None), host_ns()
        self._odometry.take_smoothed()  # otherwise they would accumulate
        self.latest = estimate
        self._meter.add_arrival("estimates", now_ns)
        self._meter.count(f"status_{estimate.status}")
        if self._first_pose_ns is None and estimate.nav_T_body is not None:
            self._first_pose_ns = now_ns
        if under_way is not None and self._is_after_start(under_way.arrival_ns):
            self._meter.add_latency(1e-6 * (now_ns - under_way.arrival_ns))
        self._publish(estimate)
        with stage.waiting():
            has_room = self.results.put((estimate, None if under_way is None else under_way.frameset))
        if not has_room:
            self._meter.count("results_not_put_out")

    def _is_after_start(self, arrival_ns: int) -> bool:
        """Return whether a frameset arrived long enough after the first pose.

        Framesets before it are held until the IMU has given the initial attitude, and then processed all at once.
        """
        return self._first_pose_ns is not None and arrival_ns > self._first_pose_ns + _START_NS

    def _is_limited(self, arrival_ns: int) -> bool:
        """Return whether the limit of the latency applies to a frameset."""
        return self._is_realtime and self._is_after_start(arrival_ns)
