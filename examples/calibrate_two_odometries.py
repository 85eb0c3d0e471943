"""Find where two cameras are on a rig from their trajectories, which two different odometries estimated.

    python calibrate_two_odometries.py RECORDING        # of a rig with two pairs that is turned about two axes

Here the front camera's trajectory is of graphvio's smoother, and the back camera's of the filter of the paper, with a
clock that is 12.345 s ahead. Trajectories of any other odometry do as well: `graphvio.load_trajectory` reads TUM, EuRoC
and KITTI files, and `graphvio calibrate-trajectories FRONT.txt BACK.txt` does all of this on the command line.
"""

from __future__ import annotations

import sys

import numpy as np

import graphvio
from graphvio.geometry import se3_inverse, so3_log

AHEAD_NS = 12_345_000_000


def trajectory(recording: str, pair: int, profile: str, ahead_ns: int) -> graphvio.Trajectory:
    """Estimate the path of a pair's left camera, by the pair alone."""
    rig = graphvio.load_rig(recording).with_pairs([pair]).without_imu()
    odometry = graphvio.Odometry(rig, graphvio.Config.load(profile))
    stamps, poses = [], []
    for measurement in graphvio.open_source(recording, rig):
        estimate = odometry.process(measurement)
        if estimate is not None and estimate.nav_T_body is not None:
            stamps.append(estimate.stamp_ns + ahead_ns)
            poses.append(estimate.nav_T_body @ rig.pairs[0].left.body_T_cam)
    return graphvio.Trajectory(np.array(stamps), np.array(poses))


def main() -> None:
    """Calibrate from the two trajectories, and compare with the rig file."""
    front = trajectory(sys.argv[1], 0, "default", 0)
    back = trajectory(sys.argv[1], 1, "paper", AHEAD_NS)
    found = graphvio.calibrate_trajectories([front, back], ["front", "back"])

    sigmas = np.sqrt(np.diag(found.covariance))
    print("back_T_front:", found.left2_T_left1.round(4).tolist())
    print("sigmas:", np.rad2deg(sigmas[:3]).round(3), "deg,", (1e3 * sigmas[3:]).round(2), "mm")
    for clock in (found.clocks or {}).values():
        print(f"the back camera's clock is {1e-9 * clock.relation.offset_ns:.4f} s ahead")
    for warning in found.warnings:
        print("warning:", warning)

    pairs = graphvio.load_rig(sys.argv[1]).pairs
    in_file = se3_inverse(pairs[1].left.body_T_cam) @ pairs[0].left.body_T_cam
    error = se3_inverse(in_file) @ found.left2_T_left1
    angle_deg = np.rad2deg(np.linalg.norm(so3_log(np.ascontiguousarray(error[:3, :3]))))
    print(f"against the rig file: {angle_deg:.3f} deg, {1e3 * np.linalg.norm(error[:3, 3]):.1f} mm")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main()
