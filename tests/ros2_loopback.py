"""A domain on the loopback for two processes, and the other process, with cyclonedds' own messages."""

from __future__ import annotations

import json
import os
import random
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

URI = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='true'/></Interfaces></General>"
    "<Discovery><LeaseDuration>1s</LeaseDuration></Discovery></Domain></CycloneDDS>"
)
"""The loopback only; participants that vanish are lost after a second."""
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 50_000_000
IMU_PERIOD_NS = 5_000_000


_taken: list[socket.socket] = []


def free_domain() -> int:
    """A domain that no other test on this machine uses while this process lives: each holds a port in token of it."""
    for domain in random.SystemRandom().sample(range(100, 231), 131):
        token = socket.socket()
        try:
            token.bind(("127.0.0.1", 20_000 + domain))
        except OSError:
            token.close()
            continue
        _taken.append(token)
        return domain
    raise RuntimeError("all ROS 2 domains from 100 to 230 are in use by tests")


def until(holds: Callable[[], bool], seconds: float = 20.0) -> bool:
    """Wait for something that takes milliseconds unless the machine is busy."""
    end_s = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.01)
    return True


class Other:
    """A process that runs one of the functions below on a domain; it does a step for each line that it gets."""

    def __init__(self, what: str, domain: int) -> None:
        here = Path(__file__).resolve()
        self.process = subprocess.Popen(
            [sys.executable, str(here), what, str(domain)],
            env={**os.environ, "CYCLONEDDS_URI": URI, "PYTHONPATH": f"{here.parents[1]}:{here.parent}"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def do(self, line: str) -> str:
        """Have a step done.

        Returns:
            Its answer when it is done.
        """
        self.send(line)
        return self.read()

    def send(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def read(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def end(self) -> None:
        """End it, if need be by force."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()


def foreign(message: Any) -> Any:
    """A message of rosbags as cyclonedds has it."""
    from graphvio.ros2.wire import idl_struct
    from graphvio.sessions import cdr

    return idl_struct(message.__msgtype__).deserialize(cdr.encode(message))


class Participant:
    """Writes and reads by cyclonedds' own types; only their names are graphvio's."""

    def __init__(self, domain: int) -> None:
        from cyclonedds.domain import DomainParticipant

        self.participant = DomainParticipant(domain)

    def _topic(self, name: str, type_name: str) -> Any:
        from cyclonedds.topic import Topic

        from graphvio.ros2.wire import idl_struct

        return Topic(self.participant, f"rt{name}", idl_struct(type_name))

    def writer(self, name: str, type_name: str, is_latched: bool = False, is_reliable: bool = True) -> Any:
        from cyclonedds.pub import DataWriter

        return DataWriter(self.participant, self._topic(name, type_name), qos=_qos(is_latched, is_reliable))

    def reader(self, name: str, type_name: str, is_latched: bool = False) -> Any:
        from cyclonedds.sub import DataReader

        return DataReader(self.participant, self._topic(name, type_name), qos=_qos(is_latched, True))


def _qos(is_latched: bool, is_reliable: bool) -> Any:
    from cyclonedds.qos import Policy, Qos

    return Qos(
        Policy.Reliability.Reliable(100_000_000) if is_reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if is_latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(1000),
    )


def robot(domain: int) -> None:
    """Publishes a rig's cameras, in several encodings, its IMU, camera_info and tf_static.

    ``K`` sends frameset K; ``cut`` an image without its end; ``await /A /B`` waits until somebody listens to all
    topics whose names begin so, and ``alone`` until nobody listens to any.
    """
    import cv2
    from recordings import SIZE_PX, noise_image, small_rig

    from graphvio.measurements.sensors import ImuSample
    from graphvio.sessions import messages

    rig = small_rig()
    here = Participant(domain)
    static = here.writer("/tf_static", messages.TRANSFORMS, is_latched=True)
    transforms = messages.static_transforms(START_NS, rig)
    transforms.transforms.append(messages.transform(START_NS, "base_link", "imu_link", IMU_PLACE))
    static.write(foreign(transforms))
    imu = here.writer("/imu", messages.IMU, is_reliable=False)
    names = [f"/{pair.name}/{side}" for pair in rig.pairs for side in ("left", "right")]
    infos = [here.writer(f"{name}/camera_info", messages.CAMERA_INFO) for name in names]
    kinds = [messages.IMAGE, messages.IMAGE, messages.COMPRESSED, messages.COMPRESSED]
    topics = [f"{name}/image_raw" + ("/compressed" if k > 1 else "") for k, name in enumerate(names)]
    images = [
        here.writer(name, kind, is_reliable=k > 1) for k, (name, kind) in enumerate(zip(topics, kinds, strict=True))
    ]
    print("ready", flush=True)
    for line in sys.stdin:
        if line.strip() == "alone":
            print(until(lambda: not any(each.get_matched_subscriptions() for each in [*images, imu])), flush=True)
            continue
        if line.startswith("await"):
            named = zip([*topics, "/imu"], [*images, imu], strict=True)
            awaited = [writer for topic, writer in named if topic.startswith(tuple(line.split()[1:]))]
            print(until(lambda: all(writer.get_matched_subscriptions() for writer in awaited)), flush=True)  # noqa: B023
            continue
        if line.strip() == "cut":
            message = messages.image(START_NS, "cam0", noise_image(0, SIZE_PX))
            message.data = message.data[:100]
            images[0].write(foreign(message))
            print("sent", flush=True)
            continue
        number = int(line)
        stamp_ns = START_NS + number * PERIOD_NS
        for k in range(PERIOD_NS // IMU_PERIOD_NS):
            sample = ImuSample(stamp_ns + k * IMU_PERIOD_NS, np.array([0.1, 0.2, number]), np.array([0.0, 0.0, 9.8]))
            message = messages.imu(sample)
            message.header.frame_id = "imu_link"
            imu.write(foreign(message))
        for k, (camera, writer, info) in enumerate(zip(rig.cameras, images, infos, strict=True)):
            pixels = noise_image(10 * number + k, SIZE_PX)
            if k == 1:
                colour = np.repeat(pixels, 3, axis=1)
                message = messages.image(stamp_ns, camera.name, colour)
                message.width, message.encoding = SIZE_PX[0], "bgr8"
            elif k > 1:
                png = cv2.imencode(".png", pixels)[1].tobytes()
                message = messages.compressed_image(stamp_ns, camera.name, png)
            else:
                message = messages.image(stamp_ns, camera.name, pixels)
            info.write(foreign(messages.camera_info(stamp_ns, camera)))
            writer.write(foreign(message))
        print("sent", flush=True)


def slam(domain: int) -> None:
    """Read the odometry's topics, and send corrections; a line is a command, as JSON."""
    here = Participant(domain)
    kinds = {
        "/graphvio/odometry": "nav_msgs/msg/Odometry",
        "/graphvio/path": "nav_msgs/msg/Path",
        "/graphvio/landmarks": "sensor_msgs/msg/PointCloud2",
        "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
    }
    readers = {name: here.reader(name, kind, is_latched=name == "/tf_static") for name, kind in kinds.items()}
    corrections = here.writer("/graphvio/correction", "geometry_msgs/msg/PoseWithCovarianceStamped")
    print(until(lambda: all(each.get_matched_publications() for each in readers.values())), flush=True)
    for line in sys.stdin:
        command = json.loads(line)
        if "take" in command:
            got = [asdict(sample) for sample in readers[command["take"]].take(1000)]
            print(json.dumps(got), flush=True)
            continue
        if "alone" in command:
            left = until(lambda: not any(each.get_matched_publications() for each in readers.values()))
            print(json.dumps(left), flush=True)
            continue
        from graphvio.sessions import cdr, messages

        pose = messages.pose_with_covariance(np.array(command["map_T_body"]), np.eye(6))
        pose.covariance = np.array(command["covariance"])  # as ROS has it
        stamped = messages.header(command["stamp_ns"], command["frame"])
        until(lambda: bool(corrections.get_matched_subscriptions()))
        corrections.write(foreign(cdr.make("geometry_msgs/msg/PoseWithCovarianceStamped", header=stamped, pose=pose)))
        print("{}", flush=True)


IMU_PLACE = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""``base_link_T_imu_link``: turned to the left."""

if __name__ == "__main__":
    {"robot": robot, "slam": slam}[sys.argv[1]](int(sys.argv[2]))
