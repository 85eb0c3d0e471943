"""Publisher of a running odometry on ROS 2: sends poses, transforms, landmarks, diagnostics; receives corrections."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

from graphvio.errors import GraphvioError, ServiceError
from graphvio.geometry import quat_wxyz_from_rotation
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.readings import host_ns
from graphvio.ros2 import messages
from graphvio.ros2.corrections import Corrections
from graphvio.ros2.frames import Frames
from graphvio.ros2.messages import CORRECTION, DIAGNOSTICS, MAP, PATH, POINTS, Level, ThinnedPath
from graphvio.ros2.node import Node, Reader, Writer, domain_of
from graphvio.ros2.parameters import SERVICES as PARAMETER_SERVICES
from graphvio.ros2.parameters import Parameters, Value
from graphvio.ros2.services import Service
from graphvio.ros2.wire import DEFAULT, TF, TF_STATIC
from graphvio.sessions.cdr import make
from graphvio.sessions.messages import (
    ODOM,
    ODOMETRY,
    TRANSFORMS,
    header,
    odometry,
    pose_stamped,
    transform,
)
from graphvio.slam.interface import Served, map_of_epoch

NODE: Final = "/graphvio"
"""Name of the node."""

_STATIC: Final = "static"  # key of the writer of static transforms; the other writers have their type as key
_DEPTH: Final = 200  # estimates that may be queued: ten seconds
_POLL_S: Final = 0.1
_PERIOD_S: Final = 1.0  # period of diagnostics and of the path
_STALE_S: Final = 2.0
_PATH_POSES: Final = 1000
_JOIN_S: Final = 5.0
_LEVELS: Final = {
    Status.TRACKING: Level.OK,
    Status.INITIALISING: Level.WARN,
    Status.COASTING: Level.WARN,
    Status.LOST: Level.ERROR,
}


class Publisher:
    """Publishes a running odometry until `close`, without ever making it wait; a context manager.

    Args:
        served: the odometry.
        domain: number of the DDS domain, or None for that of ``ROS_DOMAIN_ID``.
        namespace: name of the node, and prefix of its own topics and services.
        frames: frames of the robot; None for those of `Frames.of_rig`.
        parameters: parameters that the node's parameter services report, by names with dots.

    Raises:
        SourceError: if the domain cannot be joined.
        MissingExtraError: if the extra ``ros2`` is not installed.
    """

    def __init__(
        self,
        served: Served,
        domain: int | None = None,
        namespace: str = NODE,
        frames: Frames | None = None,
        parameters: Mapping[str, Value] | None = None,
    ) -> None:
        self._served = served
        self._frames = frames = Frames.of_rig(served.rig) if frames is None else frames
        self._node = node = Node(domain_of(None) if domain is None else domain)
        self._writers = {
            ODOMETRY: Writer(node, f"{namespace}/odometry", ODOMETRY, DEFAULT),
            PATH: Writer(node, f"{namespace}/path", PATH, DEFAULT),
            POINTS: Writer(node, f"{namespace}/landmarks", POINTS, DEFAULT),
            DIAGNOSTICS: Writer(node, "/diagnostics", DIAGNOSTICS, DEFAULT),
            TRANSFORMS: Writer(node, "/tf", TRANSFORMS, TF),
            _STATIC: Writer(node, "/tf_static", TRANSFORMS, TF_STATIC),
        }
        self._corrections = Corrections(served, frames)
        correction_reader = Reader(node, f"{namespace}/correction", CORRECTION, DEFAULT)
        reported = Parameters({**(parameters or {}), **_of_frames(frames)})
        self._services = [
            Service(node, f"{namespace}/{name}", kind, partial(reported.answer, kind))
            for name, kind in PARAMETER_SERVICES.items()
        ]
        self._estimates = served.estimates.subscribe(_DEPTH)
        self._path = ThinnedPath(_PATH_POSES)
        self._epoch: int | None = None
        self._newest: Estimate | None = None
        self._newest_s = time.monotonic()
        self._trouble = ""
        self._failure: tuple[str, Exception] | None = None  # name of a thread that failed, and its error
        self._closing = threading.Event()
        self._attempt(self._publish_frames)
        node.announce(namespace)
        wait = node.waiter([correction_reader])
        wait_for_requests = node.waiter([each.reader for each in self._services])
        tasks: dict[str, Callable[[], None]] = {
            "poses": self._publish_poses,
            "keyframes": self._publish_keyframes,
            "corrections": lambda: self._take_corrections(wait, correction_reader),
            "services": lambda: self._serve(wait_for_requests),
        }
        self._threads = [
            threading.Thread(target=self._run, args=(name, task), name=f"graphvio-ros2-{name}", daemon=True)
            for name, task in tasks.items()
        ]
        for thread in self._threads:
            thread.start()

    def check(self) -> None:
        """Check that no thread has failed.

        Raises:
            ServiceError: if a thread has failed.
        """
        if self._failure is not None:
            name, error = self._failure
            raise ServiceError(
                f"ROS 2: the thread of {name} has failed ({type(error).__name__}: {error}); start the odometry again"
            ) from error

    def close(self) -> None:
        """End the threads and leave the domain; a second call does nothing."""
        self._closing.set()
        self._estimates.close()
        self._node.stop()
        for thread in self._threads:
            thread.join(_JOIN_S)
        self._writers, self._services = {}, []
        self._node.leave()

    def __enter__(self) -> Publisher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self, name: str, task: Callable[[], None]) -> None:
        """Run a task in its thread; `check` raises its error."""
        try:
            task()
        except Exception as error:
            self._failure = name, error

    def _publish_frames(self) -> None:
        stamped = self._frames.static_transforms(host_ns(), self._served.rig)
        self._writers[_STATIC].write(make(TRANSFORMS, transforms=stamped))

    def _publish_poses(self) -> None:
        due_s = time.monotonic()
        while not self._closing.is_set():
            estimate = self._estimates.get(_POLL_S)
            if estimate is not None:
                self._newest, self._newest_s = estimate, time.monotonic()
                self._attempt(lambda: self._publish(estimate))  # noqa: B023 - called at once
            now_s = time.monotonic()
            if now_s >= due_s:
                due_s = now_s + _PERIOD_S
                self._attempt(self._publish_path)
                self._attempt(self._publish_diagnostics)
            if estimate is None and self._estimates.is_closed:
                self._closing.wait(max(due_s - now_s, 0.0))

    def _publish(self, estimate: Estimate) -> None:
        if estimate.nav_T_body is None or estimate.covariance is None:
            return
        if estimate.epoch != self._epoch:
            self._epoch = estimate.epoch
            self._path.clear()
        in_base, base = self._frames.in_base(estimate), self._frames.base
        assert in_base.nav_T_body is not None
        message = odometry(in_base)
        message.child_frame_id = base
        self._writers[ODOMETRY].write(message)
        stamped = [transform(estimate.stamp_ns, ODOM, base, in_base.nav_T_body)]
        map_T_odom = map_of_epoch(self._served, estimate.epoch)
        if map_T_odom is not None:
            stamped.append(transform(estimate.stamp_ns, MAP, ODOM, map_T_odom))
        self._writers[TRANSFORMS].write(make(TRANSFORMS, transforms=stamped))
        self._path.add(pose_stamped(estimate.stamp_ns, ODOM, in_base.nav_T_body))

    def _publish_path(self) -> None:
        if self._newest is not None and self._writers[PATH].readers:
            path = make(PATH, header=header(self._newest.stamp_ns, ODOM), poses=self._path.poses())
            self._writers[PATH].write(path)

    def _publish_diagnostics(self) -> None:
        outcomes, hardware = self._corrections.outcomes, self._served.rig.name
        refused = "refused: " if outcomes.is_refused else ""
        trouble, self._trouble = self._trouble, ""
        dropped = sum(each.refused for each in self._writers.values())
        statuses = [
            messages.diagnosis("graphvio: odometry", *self._level(), hardware, self._served.status()),
            messages.diagnosis(
                "graphvio: corrections",
                Level.WARN if refused else Level.OK,
                refused + outcomes.newest,
                hardware,
                {"accepted": outcomes.accepted, "refused": outcomes.refused},
            ),
            messages.diagnosis(
                "graphvio: publisher",
                Level.WARN if trouble else Level.OK,
                trouble or "publishing",
                hardware,
                {"estimates_missed": self._estimates.dropped(), "messages_dropped": dropped},
            ),
        ]
        self._writers[DIAGNOSTICS].write(make(DIAGNOSTICS, header=header(host_ns(), ""), status=statuses))

    def _level(self) -> tuple[Level, str]:
        silent_s = time.monotonic() - self._newest_s
        if self._estimates.is_closed:
            return Level.STALE, "the odometry has ended"
        if silent_s > _STALE_S:
            return Level.STALE, f"no estimate for {silent_s:.0f} s"
        if self._newest is None:
            return Level.WARN, "no estimate yet"
        return _LEVELS[self._newest.status], str(self._newest.status)

    def _publish_keyframes(self) -> None:
        log = self._served.keyframe_log
        next_id = log.oldest_id
        while not self._closing.is_set():
            keyframe = log.read(next_id, _POLL_S)
            if keyframe is None:
                if log.is_closed:
                    return
                continue
            next_id = keyframe.id + 1
            self._corrections.add_keyframe(keyframe)  # before the landmarks: a correction may follow them at once
            if self._writers[POINTS].readers:
                self._attempt(lambda: self._writers[POINTS].write(messages.landmarks(keyframe, self._frames.imu)))  # noqa: B023

    def _take_corrections(self, wait: Callable[[float], None], reader: Reader) -> None:
        while not self._closing.is_set():
            wait(_PERIOD_S)
            for data in reader.take():
                self._corrections.take(data)
                self._attempt(self._publish_diagnostics)

    def _serve(self, wait: Callable[[float], None]) -> None:
        while not self._closing.is_set():
            wait(_PERIOD_S)
            for service in self._services:
                self._attempt(service.take)

    def _attempt(self, action: Callable[[], Any]) -> None:
        """Run an action; an error is reported in the diagnostics, and the thread continues."""
        try:
            action()
        except GraphvioError as error:
            self._trouble = str(error)


def _of_frames(frames: Frames) -> dict[str, Value]:
    """Return the frames as parameters."""
    x, y, z = frames.base_T_body[:3, 3].tolist()
    w, *vector = quat_wxyz_from_rotation(frames.base_T_body[:3, :3]).tolist()
    return {"frames.base": frames.base, "frames.imu": frames.imu, "frames.base_T_imu": [x, y, z, *vector, w]}
