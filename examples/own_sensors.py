"""Odometry on your own sensors: measurements are made here, and handed over one by one.

    python examples/own_sensors.py RECORDING

The readings come from an EuRoC folder, by plain csv and OpenCV, in place of drivers.
"""

import csv
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import graphvio


def imu_samples(folder: Path) -> Iterator[graphvio.ImuSample]:
    """Yield what an IMU would send: rad/s and m/s^2 in the frame of body."""
    with (folder / "imu0/data.csv").open() as file:
        for stamp, *values in csv.reader(line for line in file if not line.startswith("#")):
            numbers = np.array(values, dtype=float)
            yield graphvio.ImuSample(int(stamp), numbers[:3], numbers[3:])


def framesets(folder: Path, pairs: int) -> Iterator[graphvio.FrameSet]:
    """Yield what cameras with a common trigger would send: pair index -> left and right image."""
    for image in sorted((folder / "cam0/data").glob("*.png"), key=lambda file: int(file.stem)):
        images = {}
        for j in range(pairs):
            files = [folder / f"cam{camera}/data" / image.name for camera in (2 * j, 2 * j + 1)]
            left, right = (np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), dtype=np.uint8) for file in files)
            images[j] = (left, right)
        yield graphvio.FrameSet(int(image.stem), images)


def main(recording: Path) -> None:
    """Print a pose for each frameset."""
    rig = graphvio.load_rig(recording / "rig.yaml")
    odometry = graphvio.Odometry(rig)
    samples = imu_samples(recording / "mav0")
    for frameset in framesets(recording / "mav0", len(rig.pairs)):
        for sample in samples:
            odometry.process(sample)
            if sample.stamp_ns > frameset.stamp_ns:
                break
        estimate = odometry.process(frameset)
        if estimate is not None and estimate.nav_T_body is not None:
            x, y, z = estimate.nav_T_body[:3, 3]
            print(f"{estimate.stamp_ns} {estimate.status} {x:.3f} {y:.3f} {z:.3f} m")
    for estimate in odometry.finish():
        print(estimate.stamp_ns, estimate.status)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
