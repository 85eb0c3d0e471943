"""A running odometry on ROS 2: poses, transforms, landmarks and diagnostics out, corrections in."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Final

from graphvio.errors import GraphvioError, ServiceError
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.readings import host_ns
from graphvio.ros2 import messages
from graphvio.ros2.corrections import Corrections
from graphvio.ros2.messages import CORRECTION, DIAGNOSTICS, MAP, PATH, POINTS, Level
from graphvio.ros2.node import Node, Reader, Waiter, domain_of
from graphvio.ros2.path import ThinnedPath
from graphvio.ros2.qos import DEFAULT, TF, TF_STATIC
from graphvio.sessions.messages import (
    BODY,
    ODOM,
    ODOMETRY,
    TRANSFORMS,
    odometry,
    pose_stamped,
    transform,
)
from graphvio.slam.epochs import map_of_epoch
from graphvio.slam.interface import Served

_STATIC: Final = "static"  # transforms that stay, among the writers by type
_DEPTH: Final = 200  # estimates that may wait: ten seconds
_POLL_S: Final = 0.1
_PERIOD_S: Final = 1.0  # of diagnostics and the path
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
    """Publishes until it is closed or the odometry has ended; the odometry never waits for it.

    Args:
        served: the odometry.
        domain: of DDS, or None for that of ``ROS_DOMAIN_ID``.
        namespace: what the names of graphvio's own topics begin with.
        body: the name of the rig's body, which is the IMU's frame, among the frames of ROS.

    Raises:
        SourceError: if the domain cannot be joined.
        MissingExtraError: if the extra ``ros2`` is not installed.
    """

    def __init__(
        self, served: Served, domain: int | None = None, namespace: str = "/graphvio", body: str = BODY
    ) -> None:
        self._served, self._body = served, body
        self._node = node = Node(domain_of(None) if domain is None else domain)
        self._writers = {
            ODOMETRY: node.writer(f"{namespace}/odometry", ODOMETRY, DEFAULT),
            PATH: node.writer(f"{namespace}/path", PATH, DEFAULT),
            POINTS: node.writer(f"{namespace}/landmarks", POINTS, DEFAULT),
            DIAGNOSTICS: node.writer("/diagnostics", DIAGNOSTICS, DEFAULT),
            TRANSFORMS: node.writer("/tf", TRANSFORMS, TF),
            _STATIC: node.writer("/tf_static", TRANSFORMS, TF_STATIC),
        }
        self._corrections = Corrections(served)
        correction_reader = node.reader(f"{namespace}/correction", CORRECTION, DEFAULT)
        self._estimates = served.estimates.subscribe(_DEPTH)
        self._path = ThinnedPath(_PATH_POSES)
        self._epoch: int | None = None
        self._newest: Estimate | None = None
        self._newest_s = time.monotonic()
        self._trouble = ""
        self._failure: tuple[str, Exception] | None = None  # of a thread, with its name
        self._closing = threading.Event()
        self._attempt(self._publish_places)
        tasks: dict[str, tuple[Callable[..., None], tuple[Any, ...]]] = {
            "poses": (self._publish_poses, ()),
            "keyframes": (self._publish_keyframes, ()),
            "corrections": (self._take_corrections, (node.waiter([correction_reader]), correction_reader)),
        }
        self._threads = [
            threading.Thread(target=self._run, args=(name, task, *args), name=f"graphvio-ros2-{name}", daemon=True)
            for name, (task, args) in tasks.items()
        ]
        for thread in self._threads:
            thread.start()

    def check(self) -> None:
        """Find out whether all threads live.

        Raises:
            ServiceError: if one ended before its time.
        """
        if self._failure is not None:
            name, error = self._failure
            raise ServiceError(
                f"ROS 2: nothing of {name} is published or taken any more ({type(error).__name__}: {error})"
            ) from error

    def close(self) -> None:
        """End the threads, and leave the domain; a second time does nothing."""
        self._closing.set()
        self._estimates.close()
        self._node.stop()
        for thread in self._threads:
            thread.join(_JOIN_S)
        self._writers = {}
        self._node.leave()

    def __enter__(self) -> Publisher:
        """The publisher itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()

    def _run(self, name: str, task: Callable[..., None], *args: object) -> None:
        """What a thread does; one that ends in an error is told of by `check`."""
        try:
            task(*args)
        except Exception as error:
            self._failure = name, error

    def _publish_places(self) -> None:
        now_ns = host_ns()
        # tf2 refuses names that begin with a slash, as those of cameras do that are called by their topics
        stamped = [
            transform(now_ns, self._body, camera.name.lstrip("/"), camera.body_T_cam)
            for camera in self._served.rig.cameras
        ]
        self._writers[_STATIC].write(messages.transforms(stamped))

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
        told = odometry(estimate)
        told.child_frame_id = self._body
        self._writers[ODOMETRY].write(told)
        stamped = [transform(estimate.stamp_ns, ODOM, self._body, estimate.nav_T_body)]
        map_T_odom = map_of_epoch(self._served, estimate.epoch)
        if map_T_odom is not None:
            stamped.append(transform(estimate.stamp_ns, MAP, ODOM, map_T_odom))
        self._writers[TRANSFORMS].write(messages.transforms(stamped))
        self._path.add(pose_stamped(estimate.stamp_ns, ODOM, estimate.nav_T_body))

    def _publish_path(self) -> None:
        if self._newest is not None and self._writers[PATH].readers:
            self._writers[PATH].write(messages.path(self._newest.stamp_ns, self._path.poses()))

    def _publish_diagnostics(self) -> None:
        level, said = self._level()
        outcomes = self._corrections.outcomes
        trouble, self._trouble = self._trouble, ""
        published = {
            "estimates_missed": self._estimates.dropped(),
            "messages_dropped": sum(each.refused for each in self._writers.values()),
        }
        hardware = self._served.rig.name
        self._writers[DIAGNOSTICS].write(
            messages.diagnostics(
                host_ns(),
                [
                    messages.diagnosis("graphvio: odometry", level, said, hardware, self._served.status()),
                    messages.diagnosis(
                        "graphvio: corrections",
                        Level.WARN if outcomes.is_refused else Level.OK,
                        ("refused: " if outcomes.is_refused else "") + outcomes.newest,
                        hardware,
                        {"accepted": outcomes.accepted, "refused": outcomes.refused},
                    ),
                    messages.diagnosis(
                        "graphvio: publisher",
                        Level.WARN if trouble else Level.OK,
                        trouble or "publishing",
                        hardware,
                        published,
                    ),
                ],
            )
        )

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
            self._corrections.know(keyframe)  # first: the landmarks may be answered by a correction at once
            if self._writers[POINTS].readers:
                self._attempt(lambda: self._writers[POINTS].write(messages.landmarks(keyframe, self._body)))  # noqa: B023

    def _take_corrections(self, waiter: Waiter, reader: Reader) -> None:
        while not self._closing.is_set():
            waiter.wait(_PERIOD_S)
            for sample in reader.take():
                self._corrections.take(sample.data)
                self._attempt(self._publish_diagnostics)

    def _attempt(self, action: Callable[[], Any]) -> None:
        """What cannot be published is told by the diagnostics; the rest goes on."""
        try:
            action()
        except GraphvioError as error:
            self._trouble = str(error)
