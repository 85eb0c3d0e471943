"""The ROS 2 package in ros2/: its node, run as ROS does it, and its files; colcon and RViz are not here."""

from __future__ import annotations

import ast
import os
import runpy
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import yaml

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from recordings import small_rig
from ros2_loopback import URI, free_domain, until

from graphvio.errors import ConfigError
from graphvio.ros2.node import Node, Reader
from graphvio.ros2.wire import DEFAULT
from graphvio.version import __version__

PACKAGE = Path(__file__).parents[1] / "ros2"
sys.path.append(str(PACKAGE))

from graphvio_ros.arguments import parse  # noqa: E402
from graphvio_ros.node import DEFAULTS, frames_of, parameters_of  # noqa: E402


def test_package_files_name_what_exists() -> None:
    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert (root.tag, root.get("format"), root.findtext("name")) == ("package", "3", "graphvio_ros")
    assert root.findtext("export/build_type") == "ament_python"
    assert root.findtext("version") == __version__
    assert (PACKAGE / "resource/graphvio_ros").exists()
    setup = ast.parse((PACKAGE / "setup.py").read_text())
    named = [node.value for node in ast.walk(setup) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    files = [each for each in named if "/" in each and not each.startswith(("share/", "/"))]
    assert {"launch/graphvio.launch.py", "config/graphvio.yaml", "rviz/graphvio.rviz"} <= set(files)
    assert __version__ in named


@pytest.mark.parametrize("given", [{}, {"source": "realsense"}, {"source": "oak", "rig": "rig.yaml"}])
def test_launch_file_leaves_to_the_parameter_file_what_is_not_given(
    given: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With stand-ins for the packages of ROS 2, which record how they are called."""
    nodes: list[dict[str, Any]] = []
    actions = Mock()
    actions.OpaqueFunction = lambda function: function(given)
    configuration = Mock()
    configuration.LaunchConfiguration = lambda name: Mock(perform=lambda context: context.get(name, ""))
    ros = Mock()
    ros.Node = lambda **arguments: nodes.append(arguments)
    packages = Mock()
    packages.get_package_share_directory.return_value = str(PACKAGE)
    modules = {name: Mock() for name in ("launch", "launch.conditions", "launch_ros", "ament_index_python")}
    modules |= {"launch.actions": actions, "launch.substitutions": configuration, "launch_ros.actions": ros}
    for name, module in (modules | {"ament_index_python.packages": packages}).items():
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(PACKAGE / "launch/graphvio.launch.py"))["generate_launch_description"]()
    started = next(each for each in nodes if each["package"] == "graphvio_ros")
    assert started["executable"] == "node"
    assert started["parameters"][1:] == ([given] if given else [])
    assert given.keys() <= DEFAULTS.keys()


def test_parameter_file_has_the_nodes_defaults() -> None:
    read = parameters_of(parse(["--ros-args", "--params-file", str(PACKAGE / "config/graphvio.yaml")]))
    assert read == {**DEFAULTS, "source": "ros2:"}


def topics_of(display: Any) -> list[str]:
    return [display["Topic"]["Value"]] if "Topic" in display else []


def test_node_publishes_what_rviz_shows(long_room_walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the arguments that ROS gives it; a recording is its source."""
    rviz = yaml.safe_load((PACKAGE / "rviz/graphvio.rviz").read_text())["Visualization Manager"]
    wanted = {topic for display in rviz["Displays"] for topic in topics_of(display)}
    assert len(wanted) == 3
    monkeypatch.setenv("CYCLONEDDS_URI", URI)
    domain = free_domain()
    process = subprocess.Popen(
        [sys.executable, "-m", "graphvio_ros.node", "--ros-args", "-r", "__node:=graphvio", "-r", "__ns:=/",
         "--params-file", str(PACKAGE / "config/graphvio.yaml"), "-p", f"source:=replay:{long_room_walk}?speed=0.2",
         "-p", "frames.base_T_imu:=[0.1, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0]"],
        env={**os.environ, "PYTHONPATH": str(PACKAGE), "ROS_DOMAIN_ID": str(domain)},
        stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    try:
        node = Node(domain)
        frame = Reader(node, "/graphvio/odometry", "nav_msgs/msg/Odometry", DEFAULT)
        assert until(lambda: {each.topic for each in node.publications()} >= {*wanted, "/tf", "/tf_static"}, 200.0)
        assert until(lambda: bool(frame.take()), 200.0)
        assert rviz["Global Options"]["Fixed Frame"] == "odom"
        process.terminate()
        _, printed = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, printed
    assert f"node /graphvio in domain {domain}" in printed
    node.leave()


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["--ros-args", "-p", "sauce:=simulator"], "sauce: is no parameter of the node"),
        (["--ros-args", "-r", "/tf:=/other"], "topics cannot be renamed"),
        (["--ros-args", "--params-file", "absent.yaml"], "absent.yaml: cannot be read"),
        (["--ros-args", "-p"], "-p: has no value"),
        (["--record", "x"], "--record: is no argument of a ROS 2 node"),
        (["-p", "frames.base_T_imu:=[1, 2, 3]"], "frames.base_T_imu: is not"),
        (["-p", "frames.base_T_imu:=[0, 0, 0, 0, 0, 0, 2]"], "frames.base_T_imu: is not"),
    ],
)
def test_wrong_arguments_are_refused(arguments: list[str], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        frames_of(parameters_of(parse(arguments)), small_rig())


def test_arguments_name_the_node_and_its_frames() -> None:
    arguments = parse(
        ["--ros-args", "-r", "__ns:=/robot", "-r", "__node:=vio", "--log-level", "info",
         "-p", "frames.base_T_imu:=[1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0]", "-p", "frames.base:=chassis"]
    )  # fmt: skip
    assert arguments.full_name == "/robot/vio"
    assert parse([]).full_name == "/graphvio"
    frames = frames_of(parameters_of(arguments), small_rig())
    assert (frames.base, frames.imu) == ("chassis", "imu_link")
    np.testing.assert_allclose(frames.base_T_body[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(frames.base_T_body[:3, :3], np.diag([-1.0, -1.0, 1.0]))
