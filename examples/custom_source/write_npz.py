"""Write a recording of another layout in the one of `graphvio_npz`: ``python write_npz.py RECORDING NEW_FOLDER``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from graphvio_npz import UNITS

import graphvio


def write(source: str, folder: Path) -> None:
    """Write a recording of another layout in this one."""
    recording = graphvio.open_source(source)
    (folder / "frames").mkdir(parents=True)
    graphvio.save_rig(recording.rig, folder / "rig.yaml")
    imu_stamps, values = [], []
    for measurement in recording:
        if isinstance(measurement, graphvio.ImuSample):
            imu_stamps.append(measurement.stamp_ns)
            values.append(np.concatenate([measurement.angular_velocity, measurement.linear_acceleration]) / UNITS)
            continue
        pairs = [(recording.rig.pairs[number], images) for number, images in measurement.images.items()]
        arrays = {pair.left.name: left for pair, (left, _) in pairs} | {pair.right.name: r for pair, (_, r) in pairs}
        np.savez(folder / "frames" / f"{measurement.stamp_ns}.npz", allow_pickle=False, **arrays)
    np.savez(folder / "imu.npz", stamps_ns=np.array(imu_stamps), values=np.array(values))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    write(sys.argv[1], Path(sys.argv[2]))
