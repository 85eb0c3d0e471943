"""A running odometry on ROS 2: poses, transforms, landmarks and diagnostics out, corrections in."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final

from graphvio.errors import GraphvioError, ServiceError
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.readings import host_ns
from graphvio.ros2 import messages
from graphvio.ros2.corrections import Corrections
from graphvio.ros2.messages import CORRECTION, DIAGNOSTICS, MAP, PATH, POINTS, Level, ThinnedPath
from graphvio.ros2.node import Node, Reader, Writer, domain_of
from graphvio.ros2.wire import DEFAULT, TF, TF_STATIC
from graphvio.sessions.cdr import make
from graphvio.sessions.messages import (
    BODY,
    ODOM,
    ODOMETRY,
    TRANSFORMS,
    header,
    odometry,
    pose_stamped,
    transform,
)
from graphvio.slam.interface import Served, map_of_epoch

_STATIC: Final = "static"  # the static transforms, among the writers by type
_DEPTH: Final = 200  # estimates that may be queued: ten seconds
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
    """Publishes a running odometry until one of both is closed; the odometry never waits for it.

    Args:
        served: the odometry.
        domain: of DDS, or None for that of ``ROS_DOMAIN_ID``.
        namespace: prefix of graphvio's own topics.
        body: name of the body's frame in ROS, which is the IMU's.

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
            ODOMETRY: Writer(node, f"{namespace}/odometry", ODOMETRY, DEFAULT),
            PATH: Writer(node, f"{namespace}/path", PATH, DEFAULT),
            POINTS: Writer(node, f"{namespace}/landmarks", POINTS, DEFAULT),
            DIAGNOSTICS: Writer(node, "/diagnostics", DIAGNOSTICS, DEFAULT),
            TRANSFORMS: Writer(node, "/tf", TRANSFORMS, TF),
            _STATIC: Writer(node, "/tf_static", TRANSFORMS, TF_STATIC),
        }
        self._corrections = Corrections(served)
        correction_reader = Reader(node, f"{namespace}/correction", CORRECTION, DEFAULT)
        self._estimates = served.estimates.subscribe(_DEPTH)
        self._path = ThinnedPath(_PATH_POSES)
        self._epoch: int | None = None
        self._newest: Estimate | None = None
        self._newest_s = time.monotonic()
        self._trouble = ""
        self._failure: tuple[str, Exception] | None = None  # of a thread, with its name
        self._closing = threading.Event()
        self._attempt(self._publish_camera_poses)
        wait = node.waiter([correction_reader])
        tasks: dict[str, Callable[[], None]] = {
            "poses": self._publish_poses,
            "keyframes": self._publish_keyframes,
            "corrections": lambda: self._take_corrections(wait, correction_reader),
        }
        self._threads = [
            threading.Thread(target=self._run, args=(name, task), name=f"graphvio-ros2-{name}", daemon=True)
            for name, task in tasks.items()
        ]
        for thread in self._threads:
            thread.start()

    def check(self) -> None:
        """Check that all threads run.

        Raises:
            ServiceError: if one has failed.
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
        self._writers = {}
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

    def _publish_camera_poses(self) -> None:
        now_ns = host_ns()
        # tf2 refuses names that begin with a slash, as those of cameras named by their topics do
        stamped = [
            transform(now_ns, self._body, camera.name.lstrip("/"), camera.body_T_cam)
            for camera in self._served.rig.cameras
        ]
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
        message = odometry(estimate)
        message.child_frame_id = self._body
        self._writers[ODOMETRY].write(message)
        stamped = [transform(estimate.stamp_ns, ODOM, self._body, estimate.nav_T_body)]
        map_T_odom = map_of_epoch(self._served, estimate.epoch)
        if map_T_odom is not None:
            stamped.append(transform(estimate.stamp_ns, MAP, ODOM, map_T_odom))
        self._writers[TRANSFORMS].write(make(TRANSFORMS, transforms=stamped))
        self._path.add(pose_stamped(estimate.stamp_ns, ODOM, estimate.nav_T_body))

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
            self._corrections.add_keyframe(keyframe)  # first, as a correction may follow the landmarks at once
            if self._writers[POINTS].readers:
                self._attempt(lambda: self._writers[POINTS].write(messages.landmarks(keyframe, self._body)))  # noqa: B023

    def _take_corrections(self, wait: Callable[[float], None], reader: Reader) -> None:
        while not self._closing.is_set():
            wait(_PERIOD_S)
            for data in reader.take():
                self._corrections.take(data)
                self._attempt(self._publish_diagnostics)

    def _attempt(self, action: Callable[[], Any]) -> None:
        """Run an action; if it fails, the diagnostics say so, and the thread goes on."""
        try:
            action()
        except GraphvioError as error:
            self._trouble = str(error)
