"""The odometry as a stage: it is fed, what there is no time for is given up, and estimates are handed on.

Front-end and back-end are one stage: the front-end looks for points where the back-end's newest state foretells them,
so that neither has anything to do while the other works. The front-end itself has a thread for each pair.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from graphvio.config.stages import LiveConfig
from graphvio.live.load import LoadControl
from graphvio.live.meter import Meter
from graphvio.live.stage import Stage
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.readings import host_ns
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.odometry import Odometry
from graphvio.queues import BoundedQueue, Limit, WhenFull

_WAITING_FRAMESETS = 8
_WAITING_SAMPLES = 50_000  # minutes: where so many wait, the odometry is dead
_WAITING_RESULTS = 64  # for output
_READ_AHEAD = 2  # wait for either, where the source waits: more would only take memory
_KEPT_FRAMESETS = 64  # until they are estimated
_ROUND_S = 0.05
_START_NS = 500_000_000


FRAMESETS = "framesets"
"""The lane of framesets in the inbox; samples are in the default one."""

Inbox = BoundedQueue[tuple[Measurement, int]]


def make_inbox(max_framesets: int, is_realtime: bool) -> Inbox:
    """Make the queue in front of the odometry.

    Args:
        max_framesets: that may wait.
        is_realtime: whether the oldest frameset is dropped where there is no room, and a sample where the odometry is
            dead; else whoever brings them waits.
    """
    if is_realtime:
        framesets = Limit(max_framesets, WhenFull.DROP_OLDEST)
        return BoundedQueue(_WAITING_SAMPLES, WhenFull.DROP_NEWEST, framesets=framesets)
    return BoundedQueue(_WAITING_SAMPLES, WhenFull.WAIT, framesets=Limit(max_framesets, WhenFull.WAIT))


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """An estimate with the images that it was made from, if they are still known."""

    estimate: Estimate
    frameset: FrameSet | None


@dataclass(frozen=True, slots=True, eq=False)
class _UnderWay:
    """A frameset in the odometry: when it came, and how long it had waited when it was taken."""

    frameset: FrameSet
    arrival_ns: int
    waited_ms: float


class Estimation:
    """The stage ``odometry``.

    Args:
        odometry: to be fed.
        config: the limit of the latency.
        is_realtime: whether there is one, and framesets for which there is no room go; else whoever brings them waits.
        meter: counts what is given up and how long the rest took.
        publish: is handed each estimate, in this thread.
        tell_events: passes on what the odometry has to tell.

    Attributes:
        inbox: measurements that wait for the odometry, with the host time of their arrival.
        results: what waits for the output.
        load: what is given up.
        latest: newest estimate, or None.
    """

    def __init__(
        self,
        odometry: Odometry,
        config: LiveConfig,
        is_realtime: bool,
        meter: Meter,
        publish: Callable[[Estimate], None],
        tell_events: Callable[[], None],
    ) -> None:
        self.inbox = make_inbox(_WAITING_FRAMESETS if is_realtime else _READ_AHEAD, is_realtime)
        self.results: BoundedQueue[Result] = BoundedQueue(
            _WAITING_RESULTS if is_realtime else _READ_AHEAD, WhenFull.DROP_NEWEST if is_realtime else WhenFull.WAIT
        )
        self.load = LoadControl(config.max_latency_ms)
        self.latest: Estimate | None = None
        self._odometry = odometry
        self._is_realtime = is_realtime
        self._meter = meter
        self._publish = publish
        self._tell_events = tell_events
        self._corner_share = 1.0
        self._under_way: OrderedDict[int, _UnderWay] = OrderedDict()
        self._first_pose_ns: int | None = None  # when it was made

    def estimate(self, stage: Stage) -> None:
        """Work on what comes, until its end."""
        while not self.inbox.is_finished:
            taken = self.inbox.get(self._patience_s())
            if taken is not None:
                with stage.working():
                    self._process(stage, *taken)
            elif self._patience_s() == 0.0:
                with stage.working():
                    self._process_held(stage)
        with stage.working():
            for estimate in self._odometry.finish():
                self._deliver(stage, estimate)

    def _process(self, stage: Stage, measurement: Measurement, arrival_ns: int) -> None:
        begun_ns = host_ns()
        if isinstance(measurement, FrameSet):
            waited_ms = 1e-6 * (begun_ns - arrival_ns)
            is_newest = not self.inbox.waiting(FRAMESETS)
            if self._is_limited(arrival_ns) and self.load.must_skip(waited_ms, is_newest):
                self._meter.count("skipped_late")
                return
            self._under_way[measurement.stamp_ns] = _UnderWay(measurement, arrival_ns, waited_ms)
            if len(self._under_way) > _KEPT_FRAMESETS:
                self._under_way.popitem(last=False)
        estimate = self._odometry.process(measurement)
        while estimate is not None:
            self._conclude(stage, estimate, begun_ns)
            stage.get_on()
            begun_ns = host_ns()
            estimate = self._odometry.process_due()
        self._tell_events()

    def _patience_s(self) -> float:
        """How long there is nothing to do if nothing comes: what the odometry holds must not be late for the IMU."""
        held_ns = self._odometry.held_ns
        under_way = None if held_ns is None else self._under_way.get(held_ns)
        if under_way is None or not self._is_limited(under_way.arrival_ns):
            return _ROUND_S
        waited_ms = 1e-6 * (host_ns() - under_way.arrival_ns)
        return min(max(1e-3 * (self.load.patience_ms - waited_ms), 0.0), _ROUND_S)

    def _process_held(self, stage: Stage) -> None:
        """All that has come has been taken, and the oldest frameset cannot wait for what has not."""
        begun_ns = host_ns()
        estimate = self._odometry.process_held()
        if estimate is not None:
            self._meter.count("imu_not_awaited")
            self._conclude(stage, estimate, begun_ns)

    def _conclude(self, stage: Stage, estimate: Estimate, begun_ns: int) -> None:
        """An estimate has been made since then."""
        self._tell_events()
        under_way = self._under_way.get(estimate.stamp_ns)
        if under_way is not None and self._is_limited(under_way.arrival_ns):
            self.load.note(estimate.stamp_ns, under_way.waited_ms, 1e-6 * (host_ns() - begun_ns))
            if self.load.corner_share != self._corner_share:
                self._corner_share = self.load.corner_share
                self._odometry.limit_corners(self._corner_share)
        self._deliver(stage, estimate)

    def _deliver(self, stage: Stage, estimate: Estimate) -> None:
        under_way, now_ns = self._under_way.pop(estimate.stamp_ns, None), host_ns()
        self._odometry.take_smoothed()  # else they would gather
        self.latest = estimate
        self._meter.came("estimates", now_ns)
        self._meter.count(f"status_{estimate.status}")
        if self._first_pose_ns is None and estimate.nav_T_body is not None:
            self._first_pose_ns = now_ns
        if under_way is not None and self._is_after_start(under_way.arrival_ns):
            self._meter.add_latency(1e-6 * (now_ns - under_way.arrival_ns))
        self._publish(estimate)
        result = Result(estimate, None if under_way is None else under_way.frameset)
        with stage.waiting():
            has_room = self.results.put(result)
        if not has_room:
            self._meter.count("results_not_put_out")

    def _is_after_start(self, arrival_ns: int) -> bool:
        """Whether a frameset need not wait for what went before the first pose: those until then are held until the
        IMU has told the attitude to start from, and worked on all at once."""
        return self._first_pose_ns is not None and arrival_ns > self._first_pose_ns + _START_NS

    def _is_limited(self, arrival_ns: int) -> bool:
        """Whether the limit of the latency holds for a frameset."""
        return self._is_realtime and self._is_after_start(arrival_ns)
