"""The node: graphvio's odometry on live sensors or topics, published as ROS 2 topics. rclpy is not needed."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import asdict
from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import ConfigError, GraphvioError
from graphvio.geometry import rotation_from_quat_wxyz, se3
from graphvio.live.running import LiveOdometry
from graphvio.live.sources import open_live_source
from graphvio.rig import Rig
from graphvio.rig_files import load_rig
from graphvio.ros2.frames import Frames
from graphvio.ros2.node import domain_of
from graphvio.ros2.parameters import Value, flatten
from graphvio.ros2.publisher import Publisher
from graphvio.runtime import StopSignals, set_up_threads, share_heap, sigterm_as_interrupt
from graphvio.warmup import warm_up
from graphvio_ros.arguments import NodeArguments, parse

DEFAULTS: dict[str, Value] = {
    "source": "",
    "rig": "",
    "config": "default",
    "frames.base": "base_link",
    "frames.imu": "imu_link",
    "frames.base_T_imu": [],
}
_POLL_S = 0.1
_MAX_NORM_ERROR = 1e-3


def main() -> int:
    """Run the node until its source ends or it is stopped; returns the exit code."""
    try:
        run(parse(sys.argv[1:]))
    except GraphvioError as error:
        print(f"graphvio: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def run(arguments: NodeArguments) -> None:
    """Run the node until its source ends or it is stopped.

    Raises:
        GraphvioError: if a parameter is not valid, or the sensors cannot be used.
    """
    values = parameters_of(arguments)
    if not values["source"]:
        raise ConfigError("source: is empty; give a live source, such as -p source:=ros2: or source:=realsense")
    settings, domain = Config.load(str(values["config"])), domain_of(None)
    share_heap()
    set_up_threads()
    source = open_live_source(str(values["source"]), load_rig(str(values["rig"])) if values["rig"] else None)
    with ExitStack() as stack:
        stack.callback(source.close)
        with sigterm_as_interrupt():
            rig = source.open()
            warm_up(rig, settings)
        signals = stack.enter_context(StopSignals())
        running = LiveOdometry(source, rig, settings, wants_keyframes=True)
        stack.callback(running.stop)
        shown = {**flatten(asdict(settings)), **{name: values[name] for name in ("source", "rig", "config")}}
        publisher = stack.enter_context(
            Publisher(running, domain, arguments.full_name, frames_of(values, rig), parameters=shown)
        )
        running.start()
        print(f"graphvio: node {arguments.full_name} in domain {domain}", file=sys.stderr, flush=True)
        while not running.wait(_POLL_S) and not signals.came:
            publisher.check()


def parameters_of(arguments: NodeArguments) -> dict[str, Value]:
    """Return all parameters of the node.

    Raises:
        ConfigError: if one is unknown.
    """
    unknown = sorted(arguments.parameters.keys() - DEFAULTS.keys() - {"use_sim_time"})
    if unknown:
        raise ConfigError(f"{unknown[0]}: is no parameter of the node; these are {', '.join(DEFAULTS)}")
    return {**DEFAULTS, **arguments.parameters}


def frames_of(values: dict[str, Value], rig: Rig) -> Frames:
    """Return the frames by the parameters.

    Raises:
        ConfigError: if ``frames.base_T_imu`` is not x, y, z and a unit quaternion x, y, z, w.
    """
    base, imu, given = str(values["frames.base"]), str(values["frames.imu"]), values["frames.base_T_imu"]
    if not given:
        return Frames.of_rig(rig, base, imu)
    return Frames(_pose_of(given), base, imu)


def _pose_of(given: Any) -> Float:
    try:
        numbers = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (7,) or not abs(np.linalg.norm(numbers[3:]) - 1.0) < _MAX_NORM_ERROR:
        raise ConfigError("frames.base_T_imu: is not [x, y, z, qx, qy, qz, qw] with a unit quaternion")
    return se3(rotation_from_quat_wxyz(numbers[[6, 3, 4, 5]]), numbers[:3])


if __name__ == "__main__":
    sys.exit(main())
