"""A SLAM system in a process of its own: it reads keyframes by gRPC, and corrects the odometry.

    graphvio serve "RECORDING?speed=0.5"            # prints the address
    python examples/slam_client.py 127.0.0.1:50551

The "SLAM" here chains the motions between keyframes, with the first one at a place that it knows, and never looks for a
place again. Its keyframes are written to map.txt (TUM) when the odometry has ended.
"""

import sys
from pathlib import Path

import numpy as np

from graphvio import Trajectory, save_trajectory
from graphvio.arrays import Float
from graphvio.errors import ServiceError
from graphvio.slam.client import Client

DOCK = np.array([[0.0, -1, 0, 10], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # map_T_body where the rig is switched on
SIGMAS = np.array([0.01, 0.01, 0.01, 0.1, 0.1, 0.1])  # of that pose: rad, m


def main(address: str, out: Path) -> None:
    """Map until the odometry has ended, print what comes, and write the keyframes."""
    stamps_ns: list[int] = []
    poses: list[Float] = []
    with Client(address) as odometry:
        print("pairs", [pair.name for pair in odometry.rig.pairs])
        for keyframe in odometry.keyframes():  # with_images=True sends the images as well
            if keyframe.previous_T_body is None:  # the first of an epoch
                poses.append(DOCK if not poses else poses[-1])
                result = odometry.correct(keyframe.id, poses[-1], np.diag(SIGMAS**2))
                print("corrected" if result.accepted else f"refused: {result.reason}")
            else:
                poses.append(poses[-1] @ keyframe.previous_T_body)
            stamps_ns.append(keyframe.stamp_ns)
            x, y, z = poses[-1][:3, 3]
            print(f"keyframe {keyframe.id} at {x:.2f} {y:.2f} {z:.2f} m, {len(keyframe.landmarks)} landmarks")
    if len(poses) > 1:
        save_trajectory(Trajectory(np.array(stamps_ns), np.array(poses)), out)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        main(sys.argv[1], Path("map.txt"))
    except ServiceError as error:  # nothing listens there, or the service was stopped
        sys.exit(f"slam_client: {error}")
