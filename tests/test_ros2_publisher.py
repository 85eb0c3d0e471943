"""A running odometry, published to another process that corrects it."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from recordings import small_rig
from ros2_loopback import PERIOD_NS, START_NS, URI, Other, free_domain, until
from synthetic import random_covariance, transform

from graphvio.arrays import Float
from graphvio.errors import ServiceError
from graphvio.geometry import rotation_from_quat_wxyz, se3, se3_exp, so3_log
from graphvio.measurements.estimate import Estimate, Prediction, Status
from graphvio.measurements.events import Event
from graphvio.queues import Broadcast
from graphvio.rig import Camera
from graphvio.ros2.frames import Frames, optical_frame
from graphvio.ros2.messages import ThinnedPath
from graphvio.ros2.publisher import Publisher
from graphvio.slam.keyframe import CorrectionResult, Keyframe, Landmarks
from graphvio.slam.keyframe_log import KeyframeLog

ODOMETRY, PATH, LANDMARKS = "/graphvio/odometry", "/graphvio/path", "/graphvio/landmarks"
MAP_T_ODOM = transform([0.0, 0.0, 0.3], [1.0, 2.0, 0.0])
BASE_T_BODY = transform([0.0, 0.5, 1.5], [0.4, 0.0, 0.3])
BODY_T_BASE = np.linalg.inv(BASE_T_BODY)


class Running:
    """What is served of an odometry, with poses that the test makes."""

    def __init__(self) -> None:
        rig = small_rig()
        first = replace(rig.pairs[0], left=replace(rig.pairs[0].left, name="/front/left/image_raw"))
        self.rig = replace(rig, pairs=(first, rig.pairs[1]))
        self.estimates: Broadcast[Estimate] = Broadcast()
        self.predictions: Broadcast[Prediction] = Broadcast()
        self.events: Broadcast[Event] = Broadcast()
        self.keyframe_log = KeyframeLog()
        self.map_T_odom: Float | None = None
        self.corrections: list[tuple[int, Float, Float]] = []

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        self.corrections.append((keyframe_id, map_T_body, covariance))
        if keyframe_id == 0:
            return CorrectionResult(False, "contradicts the odometry", 99.0, 16.8, None)
        self.map_T_odom = MAP_T_ODOM
        return CorrectionResult(True, "", 3.0, 16.8, MAP_T_ODOM)

    def status(self) -> Mapping[str, float | int | str | None]:
        return {"rate_hz": 19.875, "framesets": 7, "state": "tracking", "nothing": None}


def estimate(number: int, epoch: int = 0, status: Status = Status.TRACKING) -> Estimate:
    rng = np.random.default_rng(number)
    return Estimate(
        START_NS + number * PERIOD_NS,
        status,
        se3_exp(np.concatenate([rng.normal(size=3), rng.normal(size=3)])),
        random_covariance(rng, 6, 0.1),
        epoch,
        velocity_nav=rng.normal(size=3),
        velocity_covariance=random_covariance(rng, 3, 0.1),
        rates={"fused": np.array([0.1, 0.2, number]), "gyro": np.zeros(3)} if number else {},
    )


def keyframe(number: int) -> Keyframe:
    rng = np.random.default_rng(number)
    made = estimate(number)
    assert made.nav_T_body is not None
    assert made.covariance is not None
    marks = Landmarks(
        pair=np.array([0, 0, 1]),
        track_id=np.array([7, 8, 7]),
        points_body=rng.normal(size=(3, 3)),
        covariances=np.tile(np.eye(3), (3, 1, 1)),
        left_px=np.zeros((3, 2)),
        right_px=np.zeros((3, 2)),
        descriptors=np.zeros((3, 0), dtype=np.uint8),
    )
    return Keyframe(
        number, 0, made.stamp_ns, Status.TRACKING, made.nav_T_body, made.covariance, None, None, None, marks
    )


class System:
    """The odometry here, and the other process."""

    def __init__(self, domain: int) -> None:
        self.running = Running()
        self.publisher = Publisher(self.running, domain, frames=Frames(BASE_T_BODY))
        self.other = Other("slam", domain)
        assert self.other.read() == "True"
        writers = self.publisher._writers.values()  # they find their readers later than readers find them
        assert until(lambda: all(each.readers for each in writers))
        self._taken: dict[str, list[Any]] = {}

    def all_of(self, topic: str) -> list[Any]:
        """What came of a topic so far."""
        got = json.loads(self.other.do(json.dumps({"take": topic})))
        self._taken.setdefault(topic, []).extend(got)
        return self._taken[topic]

    def correct(self, stamp_ns: int, map_T_body: Float, covariance: Float, frame: str = "map") -> None:
        command = {"stamp_ns": stamp_ns, "frame": frame, "map_T_body": map_T_body.tolist()}
        self.other.do(json.dumps({**command, "covariance": covariance.reshape(-1).tolist()}))

    def wait_for_diagnosis(self, name: str, level: int, message: str) -> dict[str, str]:
        """Wait until the diagnostics have a status of this level and message; returns its values."""

        def found() -> list[dict[str, Any]]:
            statuses = [each for array in self.all_of("/diagnostics") for each in array["status"]]
            return [
                each
                for each in statuses
                if each["name"] == name and each["level"] == level and message in each["message"]
            ]

        assert until(lambda: bool(found()))
        return {each["key"]: each["value"] for each in found()[-1]["values"]}

    def close(self) -> None:
        self.publisher.close()
        self.publisher.close()
        has_left = self.other.do(json.dumps({"alone": True}))
        self.other.end()
        assert has_left == "true"


@pytest.fixture
def system(monkeypatch: pytest.MonkeyPatch) -> Iterator[System]:
    monkeypatch.setenv("CYCLONEDDS_URI", URI)
    monkeypatch.setattr("graphvio.ros2.publisher._PERIOD_S", 0.1)  # of what tests wait for
    made = System(free_domain())
    yield made
    made.close()
    assert not [each for each in threading.enumerate() if each.name.startswith("graphvio-ros2")]


def stamp_of(header: dict[str, Any]) -> int:
    return int(header["stamp"]["sec"]) * 10**9 + int(header["stamp"]["nanosec"])


def pose_in(message: dict[str, Any], rotation: str, translation: str) -> Float:
    q, t = message[rotation], message[translation]
    return se3(rotation_from_quat_wxyz(np.array([q["w"], q["x"], q["y"], q["z"]])), np.array([t["x"], t["y"], t["z"]]))


def jacobian_of_base(a_T_body: Float) -> Float:
    """Errors of base's pose as ROS has them, translation and rotation in a's axes, by those of body's pose."""
    a_T_base, columns = a_T_body @ BODY_T_BASE, []
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        moved = a_T_body @ se3_exp(step) @ BODY_T_BASE
        turned = so3_log(moved[:3, :3] @ a_T_base[:3, :3].T)
        columns.append(np.concatenate([moved[:3, 3] - a_T_base[:3, 3], turned]) / 1e-6)
    return np.array(columns).T


def covariance_of_base(each: Estimate) -> Float:
    assert each.nav_T_body is not None
    assert each.covariance is not None
    jacobian = jacobian_of_base(each.nav_T_body)
    return jacobian @ each.covariance @ jacobian.T


def test_publisher_sends_poses_transforms_and_path(system: System) -> None:
    made = [estimate(number) for number in range(10)]
    for each in made:
        system.running.estimates.publish(each)
    assert until(lambda: len(system.all_of(ODOMETRY)) == 10 and len(system.all_of("/tf")) == 10)
    for message, moved, each in zip(system.all_of(ODOMETRY), system.all_of("/tf"), made, strict=True):
        assert each.nav_T_body is not None
        assert each.covariance is not None
        assert each.velocity_nav is not None
        assert (stamp_of(message["header"]), message["header"]["frame_id"]) == (each.stamp_ns, "odom")
        assert message["child_frame_id"] == "base_link"
        nav_T_base = each.nav_T_body @ BODY_T_BASE
        np.testing.assert_allclose(pose_in(message["pose"]["pose"], "orientation", "position"), nav_T_base)
        covariance = np.array(message["pose"]["covariance"]).reshape(6, 6)
        np.testing.assert_allclose(covariance, covariance_of_base(each), rtol=1e-4, atol=1e-7)
        rate = each.rates.get("fused", np.full(3, np.nan))  # of body
        moved_by_turn = np.cross(rate, BODY_T_BASE[:3, 3])
        linear = message["twist"]["twist"]["linear"]
        velocity = BASE_T_BODY[:3, :3] @ (each.nav_T_body[:3, :3].T @ each.velocity_nav + moved_by_turn)
        np.testing.assert_allclose([linear["x"], linear["y"], linear["z"]], velocity)
        angular = message["twist"]["twist"]["angular"]
        np.testing.assert_allclose([angular["x"], angular["y"], angular["z"]], BASE_T_BODY[:3, :3] @ rate)
        assert np.isnan(np.array(message["twist"]["covariance"]).reshape(6, 6)[3:]).all()
        (link,) = moved["transforms"]
        assert (link["header"]["frame_id"], link["child_frame_id"]) == ("odom", "base_link")
        assert stamp_of(link["header"]) == each.stamp_ns
        np.testing.assert_allclose(pose_in(link["transform"], "rotation", "translation"), nav_T_base)
    assert until(lambda: any(len(each["poses"]) == 10 for each in system.all_of(PATH)))
    poses = system.all_of(PATH)[-1]["poses"]
    assert [stamp_of(each["header"]) for each in poses] == [each.stamp_ns for each in made]
    system.running.estimates.publish(estimate(20, epoch=1))
    assert until(lambda: len(system.all_of(PATH)[-1]["poses"]) == 1)


def test_publisher_latches_camera_poses(system: System) -> None:
    assert until(lambda: len(system.all_of("/tf_static")) == 1)
    (message,) = system.all_of("/tf_static")
    first, *others = message["transforms"]
    assert (first["header"]["frame_id"], first["child_frame_id"]) == ("base_link", "imu_link")
    np.testing.assert_allclose(pose_in(first["transform"], "rotation", "translation"), BASE_T_BODY, atol=1e-12)
    names = ["front/left", "cam1", "cam2", "cam3"]
    for link, name, camera in zip(others, names, system.running.rig.cameras, strict=True):
        assert (link["header"]["frame_id"], link["child_frame_id"]) == ("imu_link", f"{name}_optical_frame")
        np.testing.assert_allclose(pose_in(link["transform"], "rotation", "translation"), camera.body_T_cam, atol=1e-12)


def test_publisher_diagnostics_report_status(system: System) -> None:
    for status, level in ((Status.TRACKING, 0), (Status.COASTING, 1), (Status.LOST, 2)):
        system.running.estimates.publish(estimate(1, status=status))
        values = system.wait_for_diagnosis("graphvio: odometry", level, str(status))
        assert values == {"rate_hz": "19.875", "framesets": "7", "state": "tracking"}
    system.running.estimates.publish(replace(estimate(1), stamp_ns=-1))
    system.wait_for_diagnosis("graphvio: publisher", 1, "which ROS messages can hold")
    system.running.estimates.close()
    system.wait_for_diagnosis("graphvio: odometry", 3, "the odometry has ended")


def test_publisher_sends_keyframes_and_applies_corrections(system: System) -> None:
    keyframes = [keyframe(number) for number in range(4)]
    for each in keyframes:
        system.running.keyframe_log.add(each)
    assert until(lambda: len(system.all_of(LANDMARKS)) == 4)
    for cloud, each in zip(system.all_of(LANDMARKS), keyframes, strict=True):
        assert (stamp_of(cloud["header"]), cloud["header"]["frame_id"]) == (each.stamp_ns, "imu_link")
        columns = {field["name"]: (field["offset"], field["datatype"]) for field in cloud["fields"]}
        assert columns == {"x": (0, 7), "y": (4, 7), "z": (8, 7), "track_id": (12, 6), "pair": (16, 6)}
        rows = np.array(cloud["data"], dtype=np.uint8).reshape(3, cloud["point_step"])
        points = rows[:, :12].copy().view("<f4")
        np.testing.assert_allclose(points, each.landmarks.points_body, rtol=1e-6)
        np.testing.assert_array_equal(rows[:, 12:].copy().view("<u4"), [[7, 0], [8, 0], [7, 1]])

    map_T_body = transform([0.2, -0.4, 1.0], [4.0, 5.0, 6.0])
    map_T_base = map_T_body @ BODY_T_BASE
    in_body = random_covariance(np.random.default_rng(5), 6, 0.1)
    to_ros = jacobian_of_base(map_T_body)
    as_ros = to_ros @ in_body @ to_ros.T
    system.correct(keyframes[2].stamp_ns + 400_000, map_T_base, as_ros)
    assert until(lambda: len(system.running.corrections) == 1)
    number, pose, covariance = system.running.corrections[0]
    assert number == 2
    np.testing.assert_allclose(pose, map_T_body, atol=1e-12)
    np.testing.assert_allclose(covariance, in_body, rtol=1e-4, atol=1e-7)
    system.running.estimates.publish(estimate(30))
    assert until(lambda: any(len(each["transforms"]) == 2 for each in system.all_of("/tf")))
    link = system.all_of("/tf")[-1]["transforms"][1]
    assert (link["header"]["frame_id"], link["child_frame_id"]) == ("map", "odom")
    np.testing.assert_allclose(pose_in(link["transform"], "rotation", "translation"), MAP_T_ODOM, atol=1e-12)

    stamp_ns = keyframes[3].stamp_ns
    refused: list[tuple[int, Float, str, str]] = [
        (keyframes[0].stamp_ns, as_ros, "map", "keyframe 0: contradicts the odometry"),
        (stamp_ns + 10_000_000, as_ros, "map", "the nearest keyframe is 10 ms off"),
        (stamp_ns, as_ros, "odom", "a correction in frame 'odom'"),
        (stamp_ns, np.zeros((6, 6)), "map", "not positive definite"),
    ]
    for count, (when_ns, wrong, frame, why) in enumerate(refused, 1):
        system.correct(when_ns, map_T_base, wrong, frame)
        values = system.wait_for_diagnosis("graphvio: corrections", 1, why)
        assert values == {"accepted": "1", "refused": str(count)}
    assert [number for number, _, _ in system.running.corrections] == [2, 0]


def test_publisher_check_reports_failed_thread(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    system.publisher.check()

    def broken() -> dict[str, float]:
        raise ZeroDivisionError("no figures")

    monkeypatch.setattr(system.running, "status", broken)

    def is_reported() -> bool:
        try:
            system.publisher.check()
        except ServiceError as error:
            return "thread of poses has failed" in str(error) and "no figures" in str(error)
        return False

    assert until(is_reported)


def test_thinned_path_is_bounded_and_uniform() -> None:
    path = ThinnedPath(8)
    for number in range(1000):
        path.add(number)
        poses = path.poses()
        assert len(poses) <= 9
        assert (poses[0], poses[-1]) == (0, number)
    steps = np.diff(path.poses()[:-1])
    assert len(path.poses()) >= 4
    assert (steps == steps[0]).all()
    path.clear()
    assert path.poses() == []


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [np.pi / 2, 0.0, 0.0], [0.0, -np.pi / 2, 0.0], [0.0, 0.0, np.pi]])
def test_base_link_looks_ahead_with_axes_of_the_imu(turn: list[float]) -> None:
    tilt = transform([0.1, -0.2, 0.15], [0.0, 0.0, 0.0])  # of the cameras, which does not tilt base_link
    old_T_new = transform(turn, [0.0, 0.0, 0.0])  # another IMU on the same rig

    def turned(camera: Camera) -> Camera:
        return replace(camera, body_T_cam=old_T_new.T @ tilt @ camera.body_T_cam)

    frames = Frames.of_rig(small_rig().with_cameras(turned))
    np.testing.assert_allclose(frames.base_T_body, old_T_new, atol=1e-12)


def test_base_link_of_a_rig_without_pairs_is_by_the_first_camera() -> None:
    rig = small_rig()
    alone = Frames.of_rig(rig.without_pairs())
    np.testing.assert_array_equal(alone.base_T_body, Frames.of_rig(rig).base_T_body)


@pytest.mark.parametrize(
    ("camera", "frame"),
    [
        ("cam0", "cam0_optical_frame"),
        ("/front/left/image_raw/compressed", "front/left_optical_frame"),
        ("left_optical_frame", "left_optical_frame"),
    ],
)
def test_optical_frame_is_named_by_camera(camera: str, frame: str) -> None:
    assert optical_frame(camera) == frame
