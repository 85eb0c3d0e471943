"""A recorded IMU and the truth, read from an EuRoC folder."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.backend.inertial import ImuBuffer
from graphvio.errors import GraphvioError
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.sensors import ImuSample
from graphvio.sources.faults import FaultLog
from graphvio.sources.tables import ImuTable, read_imu_csv
from graphvio.trajectory_files import load_trajectory

FRAMES_HZ = 20
STEP_NS = 1_000_000_000 // FRAMES_HZ
_MAX_GAP_S = 0.05
_BIAS_COLUMNS = range(11, 17)  # columns of the biases of gyro and accelerometer


@dataclass(frozen=True, eq=False)
class Truth:
    """True states of the IMU.

    Attributes:
        world_T_body: (N, 4, 4) poses.
        velocity_world: (N, 3) velocities in world, m/s.
        gyro_bias: (N, 3) biases of the gyro, rad/s.
        accel_bias: (N, 3) biases of the accelerometer, m/s^2.
    """

    world_T_body: Float
    velocity_world: Float
    gyro_bias: Float
    accel_bias: Float


@dataclass(frozen=True, eq=False)
class Flight:
    """The IMU readings in steps of 50 ms, and the true states of the file at the stamps between them.

    Attributes:
        stamps_ns: stamps of the N states.
        intervals: IMU readings from each stamp to the next, N - 1 intervals.
        recorded: states of the file; the velocities are derived from its positions.
    """

    stamps_ns: list[int]
    intervals: list[ImuInterval]
    recorded: Truth

    @staticmethod
    def read(folder: Path) -> Flight:
        """Read the IMU and the truth of an EuRoC folder.

        Raises:
            GraphvioError: if a file is missing or either of them has gaps.
        """
        if not folder.is_dir():
            raise GraphvioError(f"{folder}: there is no such folder; give that of EuRoC's V1_01 with --recording")
        table = read_imu_csv(folder / "mav0" / "imu0" / "data.csv", FaultLog(folder.name))
        path = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
        truth = load_trajectory(path)
        columns = _bias_columns(path, len(truth))
        first = max(truth.stamps_ns[0], table.stamps_ns[0])
        stamps = np.arange(first, min(truth.stamps_ns[-1], table.stamps_ns[-1]) + 1, STEP_NS)
        poses, known = truth.at(stamps, _MAX_GAP_S)
        if not known.all() or len(stamps) < 2:
            raise GraphvioError(f"{path}: has a gap of more than {_MAX_GAP_S:g} s; choose another recording")
        seconds, at = (1e-9 * (each - first) for each in (truth.stamps_ns, stamps))
        biases = np.stack([np.interp(at, seconds, column) for column in columns.T], axis=1)
        velocity = np.gradient(poses.positions, 1e-9 * STEP_NS, axis=0)
        recorded = Truth(poses.nav_T_body, velocity, biases[:, :3], biases[:, 3:])
        return Flight(stamps.tolist(), list(_intervals(table, stamps, folder)), recorded)


def _bias_columns(path: Path, rows: int) -> Float:
    """Read the biases (N, 6) of gyro and accelerometer from the file of the truth."""
    try:
        columns = np.loadtxt(path, delimiter=",", comments="#", usecols=_BIAS_COLUMNS)
    except (ValueError, IndexError) as error:
        raise GraphvioError(f"{path}: holds no biases ({error}); give EuRoC's own file") from None
    if columns.shape != (rows, len(_BIAS_COLUMNS)):
        raise GraphvioError(f"{path}: holds biases of {len(columns)} rows of {rows}; give EuRoC's own file")
    return columns


def _intervals(table: ImuTable, stamps_ns: Int, folder: Path) -> Iterator[ImuInterval]:
    """Yield the IMU readings between consecutive stamps (N,), as the odometry's buffer returns them."""
    buffer, added = ImuBuffer(1e3 * _MAX_GAP_S), 0
    for start_ns, end_ns in zip(stamps_ns[:-1].tolist(), stamps_ns[1:].tolist(), strict=True):
        while not buffer.covers(end_ns):
            buffer.add(ImuSample(int(table.stamps_ns[added]), table.values[added, :3], table.values[added, 3:]))
            added += 1
        interval = buffer.interval(start_ns, end_ns)
        if interval is None:
            raise GraphvioError(f"{folder}: its IMU has a gap of more than {_MAX_GAP_S:g} s; choose another recording")
        yield interval
        buffer.discard_before(end_ns)
