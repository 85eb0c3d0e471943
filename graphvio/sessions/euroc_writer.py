"""Writer of recordings in the EuRoC/ASL layout, with graphvio's ``rig.yaml`` next to ``mav0``."""

from __future__ import annotations

import re
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np

from graphvio.arrays import Float
from graphvio.errors import RigError
from graphvio.geometry import quat_wxyz_from_rotation
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.rig import Rig
from graphvio.rig_files import save_rig
from graphvio.rig_files.native import FILE_NAME
from graphvio.sessions import euroc_layout
from graphvio.sessions.euroc_layout import IMU_FOLDER, TRUTH_FOLDER
from graphvio.sessions.storage import RecordingWriter, exists_error, not_writable_error

if TYPE_CHECKING:
    from graphvio.measurements.events import Event

_COMMENT = "converted by graphvio"


class EurocWriter(RecordingWriter):
    """Writes measurements as a folder; values of the IMU and poses can be read back exactly.

    Images have the stamps of their framesets.

    Args:
        path: path of the folder, which must not exist, or be empty.
        rig: the rig of the framesets.

    Attributes:
        rig: the rig as written: its cameras are renamed to ``cam0``, ``cam1`` and so on if they have other names, and
            have no stamp offsets, as the stamps of framesets are corrected.

    Raises:
        SessionError: if the folder is not empty or cannot be created.
    """

    def __init__(self, path: Path, rig: Rig) -> None:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise exists_error(path)
        super().__init__(path, _renamed(rig))
        self._mav0 = path / "mav0"
        self._stamps: dict[str, list[int]] = {camera.name: [] for camera in self.rig.cameras}
        self._tables: dict[str, TextIO] = {}
        self._open = ExitStack()
        try:
            self._begin()
        except OSError as error:
            self._open.close()
            raise not_writable_error(path, error) from None

    def add(self, measurement: Measurement) -> None:
        """Write an IMU sample or a frameset."""
        self._guarded(lambda: self._add(measurement))

    def add_true_pose(self, stamp_ns: int, world_T_body: Float) -> None:
        """Write a pose ``world_T_body`` (4, 4) of the true trajectory."""
        quat_wxyz = quat_wxyz_from_rotation(np.ascontiguousarray(world_T_body[:3, :3]))
        row = euroc_layout.exact_row(stamp_ns, [*world_T_body[:3, 3], *quat_wxyz])
        self._guarded(lambda: self._add_row(TRUTH_FOLDER, row))

    def add_event(self, event: Event) -> None:
        """Ignore the event: the layout has no place for it."""

    def close(self) -> None:
        """Finish the folder; a second time does nothing."""
        try:
            if self.stopped is None:
                self._write_sensors()
            self._open.close()
        except OSError as error:
            self._stop(error)

    def _begin(self) -> None:
        self._mav0.mkdir(parents=True)
        try:
            save_rig(self.rig, self.path / FILE_NAME)
        except RigError as error:
            raise OSError(None, str(error)) from None
        for camera in self.rig.cameras:
            (self._mav0 / camera.name / "data").mkdir(parents=True)
            self._add_table(camera.name, euroc_layout.FRAME_HEADER)
        if self.rig.imu is not None:
            self._add_table(IMU_FOLDER, euroc_layout.IMU_HEADER)

    def _add_table(self, folder: str, header: str) -> None:
        (self._mav0 / folder).mkdir(exist_ok=True)
        table = (self._mav0 / folder / "data.csv").open("w", encoding="ascii")
        self._tables[folder] = self._open.enter_context(table)
        table.write(header + "\n")

    def _add_row(self, folder: str, row: str) -> None:
        if folder == TRUTH_FOLDER and folder not in self._tables:
            self._add_table(folder, euroc_layout.POSE_HEADER)
        self._tables[folder].write(row + "\n")

    def _add(self, measurement: Measurement) -> None:
        if not isinstance(measurement, FrameSet):
            values = [*measurement.angular_velocity, *measurement.linear_acceleration]
            self._add_row(IMU_FOLDER, euroc_layout.exact_row(measurement.stamp_ns, values))
            return
        for number, images in sorted(measurement.images.items()):
            for camera, image in zip(self.rig.groups[number].cameras, images, strict=True):
                euroc_layout.write_image(self._mav0 / camera.name / "data" / f"{measurement.stamp_ns}.png", image)
                self._add_row(camera.name, euroc_layout.frame_row(measurement.stamp_ns))
                self._stamps[camera.name].append(measurement.stamp_ns)
            for camera, mask in zip(self.rig.groups[number].cameras, measurement.masks.get(number, ()), strict=False):
                if mask is not None:
                    folder = self._mav0 / camera.name / euroc_layout.MASKS_FOLDER
                    folder.mkdir(exist_ok=True)
                    euroc_layout.write_image(folder / f"{measurement.stamp_ns}.png", mask)

    def _write_sensors(self) -> None:
        for camera in self.rig.cameras:
            text = euroc_layout.camera_yaml(camera, _rate_hz(self._stamps[camera.name]), f"{camera.name}, {_COMMENT}")
            (self._mav0 / camera.name / "sensor.yaml").write_text(text, encoding="utf-8")
        if self.rig.imu is not None:
            (self._mav0 / IMU_FOLDER / "sensor.yaml").write_text(euroc_layout.imu_yaml(self.rig.imu, _COMMENT))
        if TRUTH_FOLDER in self._tables:
            (self._mav0 / TRUTH_FOLDER / "sensor.yaml").write_text(euroc_layout.truth_yaml(_COMMENT))


def _renamed(rig: Rig) -> Rig:
    if all(re.fullmatch(r"cam\d+", camera.name) for camera in rig.cameras):
        return rig
    names = {camera.name: f"cam{k}" for k, camera in enumerate(rig.cameras)}
    return rig.with_cameras(lambda camera: replace(camera, name=names[camera.name]))


def _rate_hz(stamps_ns: list[int]) -> float:
    """Return the rate from the median interval; 0 if there is none."""
    return 1e9 / float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
