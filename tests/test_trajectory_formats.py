"""``evaluate`` and ``compare`` read what evo reads, and agree with it on the same files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import graphvio
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from test_bags import Message, ros1_bag, ros2_bag
from test_evaluation import ELSEWHERE, walk

from graphvio.errors import TrajectoryError
from graphvio.geometry import quat_wxyz_from_rotation
from graphvio.sessions import cdr
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory, save_trajectory

TRUTH = walk(400)
ESTIMATE = walk(400, drift_m=0.01).transformed(ELSEWHERE)


def euroc(poses: Trajectory, path: Path) -> None:
    rows = ["#timestamp,x,y,z,qw,qx,qy,qz"]
    for stamp, pose in zip(poses.stamps_ns, poses.nav_T_body, strict=True):
        values = (*pose[:3, 3], *quat_wxyz_from_rotation(pose[:3, :3].copy()))
        rows.append(",".join([str(stamp), *(f"{value:.9f}" for value in values)]))
    path.write_text("\n".join(rows) + "\n")


def kitti(poses: Trajectory, path: Path) -> None:
    path.write_text("".join(" ".join(f"{v:.12e}" for v in pose[:3].ravel()) + "\n" for pose in poses.nav_T_body))


def message_of(kind: str, stamp_ns: int, pose: Any) -> tuple[str, bytes]:
    """Type and CDR of a message with a pose."""
    made = cdr.types().types
    w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3].copy())
    time = made["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = made["std_msgs/msg/Header"](stamp=time, frame_id="world")
    rotation = made["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    vector = made["geometry_msgs/msg/Vector3"]
    at = made["geometry_msgs/msg/Pose"](made["geometry_msgs/msg/Point"](*pose[:3, 3]), rotation)
    with_covariance = made["geometry_msgs/msg/PoseWithCovariance"](at, np.zeros(36))
    if kind == "PoseStamped":
        message = made["geometry_msgs/msg/PoseStamped"](header, at)
    elif kind == "PoseWithCovarianceStamped":
        message = made["geometry_msgs/msg/PoseWithCovarianceStamped"](header, with_covariance)
    elif kind == "TransformStamped":
        moved = made["geometry_msgs/msg/Transform"](vector(*pose[:3, 3]), rotation)
        message = made["geometry_msgs/msg/TransformStamped"](header, "body", moved)
    else:
        speed = made["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        twist = made["geometry_msgs/msg/TwistWithCovariance"](speed, np.zeros(36))
        message = made["nav_msgs/msg/Odometry"](header, "body", with_covariance, twist)
    return message.__msgtype__, cdr.encode(message)


def messages(poses: Trajectory, topic: str, kind: str) -> list[Message]:
    found = []
    for stamp, pose in zip(poses.stamps_ns.tolist(), poses.nav_T_body, strict=True):
        type_name, data = message_of(kind, stamp, pose)
        found.append((topic, type_name, stamp + 1_000_000, data))
    return found


def read_bag(path: Path, topic: str) -> Any:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    with Reader1(path) if path.suffix == ".bag" else Reader2(path) as reader:
        return file_interface.read_bag_trajectory(reader, topic)


def rmse_by_evo(truth: Any, estimate: Any) -> float:
    truth, estimate = sync.associate_trajectories(truth, estimate, max_diff=1e-3)
    estimate.align(truth, correct_scale=False)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((truth, estimate))
    return float(error.get_statistic(metrics.StatisticsType.rmse))


def by_text(write: Callable[[Trajectory, Path], None], read: Callable[[str], Any], suffix: str) -> Any:
    def make(folder: Path) -> tuple[list[object], Any, Any]:
        paths = [folder / f"{name}{suffix}" for name in ("estimate", "truth")]
        for poses, path in zip((ESTIMATE, TRUTH), paths, strict=True):
            write(poses, path)
        return [*paths], read(str(paths[1])), read(str(paths[0]))

    return make


def by_kitti(folder: Path) -> tuple[list[object], Any, Any]:
    arguments, truth, estimate = by_text(kitti, file_interface.read_kitti_poses_file, ".txt")(folder)
    times = folder / "stamps.txt"
    times.write_text("".join(f"{stamp // 10**9}.{stamp % 10**9:09d}\n" for stamp in TRUTH.stamps_ns))
    seconds = 1e-9 * (TRUTH.stamps_ns - TRUTH.stamps_ns[0])
    truth, estimate = (PoseTrajectory3D(poses_se3=each.poses_se3, timestamps=seconds) for each in (truth, estimate))
    return [*arguments, "--times", times], truth, estimate


def by_bag(kind: str, storage: str) -> Any:
    def make(folder: Path) -> tuple[list[object], Any, Any]:
        both = [*messages(ESTIMATE, "/odometry", kind), *messages(TRUTH, "/vicon/pose", kind)]
        both.sort(key=lambda message: message[2])
        path = ros1_bag(both, folder / "walk.bag") if storage == "ros1" else ros2_bag(both, folder / "walk", storage)
        arguments: list[object] = [f"{path}:/odometry", f"{path}:/vicon/pose"]
        return arguments, read_bag(path, "/vicon/pose"), read_bag(path, "/odometry")

    return make


FORMATS = {
    "tum": by_text(save_trajectory, file_interface.read_tum_trajectory_file, ".txt"),
    "euroc": by_text(euroc, file_interface.read_euroc_csv_trajectory, ".csv"),
    "kitti": by_kitti,
    "ROS 1, odometry": by_bag("Odometry", "ros1"),
    "ROS 1, transform": by_bag("TransformStamped", "ros1"),
    "ROS 2, pose": by_bag("PoseStamped", "SQLITE3"),
    "MCAP, pose with covariance": by_bag("PoseWithCovarianceStamped", "MCAP"),
}


@pytest.mark.parametrize("name", FORMATS)
def test_evaluate_and_compare_agree_with_evo_on_its_formats(name: str, tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    (estimate, truth, *options), evo_truth, evo_estimate = FORMATS[name](tmp_path)
    expected = rmse_by_evo(evo_truth, evo_estimate)
    assert expected > 0.05
    ran = graphvio("evaluate", estimate, truth, *options, "--json")
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)["ate_position_m"]["rmse"] == pytest.approx(expected, rel=1e-6)
    ran = graphvio("compare", estimate, "--truth", truth, *options, "--json")
    assert ran.returncode == 0, ran.stderr
    (result,) = json.loads(ran.stdout)["results"]
    assert result["evaluation"]["ate_position_m"]["rmse"] == pytest.approx(expected, rel=1e-6)


def test_bag_with_one_topic_of_poses_needs_no_name(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    path = ros1_bag(messages(TRUTH, "/odometry", "Odometry"), tmp_path / "walk.bag")
    loaded = load_trajectory(path)
    np.testing.assert_array_equal(loaded.stamps_ns, TRUTH.stamps_ns)
    np.testing.assert_allclose(loaded.nav_T_body, TRUTH.nav_T_body, atol=1e-9)


def test_topics_without_poses_or_several_are_named(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    both = [*messages(TRUTH, "/a", "Odometry"), *messages(TRUTH, "/b", "PoseStamped")]
    path = ros1_bag(sorted(both, key=lambda message: message[2]), tmp_path / "walk.bag")
    with pytest.raises(TrajectoryError, match=r"poses on several topics \(/a, /b\); give one as .*walk.bag:TOPIC"):
        load_trajectory(path)
    with pytest.raises(TrajectoryError, match="has no poses on /c; topics with poses: /a, /b"):
        load_trajectory(f"{path}:/c")
    with pytest.raises(TrajectoryError, match="is no trajectory file"):
        load_trajectory(tmp_path / "none.bag:/a")


def test_kitti_poses_without_stamps_are_refused(tmp_path: Path) -> None:
    kitti(TRUTH, tmp_path / "poses.txt")
    with pytest.raises(TrajectoryError, match="carry no stamps; give --times FILE"):
        load_trajectory(tmp_path / "poses.txt")
