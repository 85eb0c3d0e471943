"""The odometry in front of a SLAM system: keyframes out, a correction in.

    python examples/slam_front_end.py RECORDING

The "SLAM" here only knows that the map is turned against odom, and says so once, at the fifth keyframe.
"""

import sys
from pathlib import Path

import numpy as np

import graphvio
from graphvio.slam import FrontEnd
from graphvio.slam.keyframe import Keyframe


def main(recording: Path) -> None:
    """Print each keyframe, and the last pose in odom and in the map."""
    source = graphvio.open_source(recording)
    odometry = graphvio.Odometry(source.rig)
    front_end = FrontEnd(odometry)  # before the first measurement
    keyframes: list[Keyframe] = []
    front_end.on_keyframe(keyframes.append)
    map_T_odom = np.array([[0.0, -1, 0, 10], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    is_corrected, last = False, None
    for measurement in source:
        estimate = odometry.process(measurement)
        if estimate is not None and estimate.nav_T_body is not None:
            last = estimate
        if len(keyframes) >= 5 and not is_corrected:
            newest = keyframes[-1]
            front_end.correct(newest.id, map_T_odom @ newest.odom_T_body, np.diag([1e-6] * 3 + [1e-4] * 3))
            is_corrected = True
    for keyframe in keyframes:
        print(f"keyframe {keyframe.id} at {keyframe.stamp_ns}")
    if last is not None and last.nav_T_body is not None:
        in_map = front_end.map_T_body(last.stamp_ns)
        print("odom", np.round(last.nav_T_body[:3, 3], 2).tolist())
        print("map", None if in_map is None else np.round(in_map[:3, 3], 2).tolist())


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
