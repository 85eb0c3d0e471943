"""Calibrations that were estimated in live runs, stored for the next run with the same devices.

A calibration is stored as a rig file in the user's cache, ``calibrations/DEVICES.DIGEST.yaml``; the time of storing is
the file's modification time. The digest is that of the rig that the run was given: a calibration that was estimated
with another rig file does not apply to this one.
"""

from __future__ import annotations

import hashlib
import os
import time
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from graphvio.calibration_sigmas import CalibrationSigmas
from graphvio.errors import RigError
from graphvio.kernel_cache import cache_root
from graphvio.odometry import Odometry
from graphvio.reporting.files import replace_file
from graphvio.rig import Rig
from graphvio.rig_files import load_rig
from graphvio.rig_files.native import to_text
from graphvio.self_calibration.online import WALK

_DIGITS = 12  # of the digest, in a file's name
_WITHOUT_SERIALS = "rig"
_NAMED_BY_SERIAL = ("realsense", "oak", "simulator")
_NAMED_BY_RIG = ("v4l2", "ros2")


class Remembered(NamedTuple):
    """A stored calibration.

    Attributes:
        rig: the stored rig, with standard deviations widened for the time since.
        saved: when it was stored, local time.
    """

    rig: Rig
    saved: datetime


class CalibrationMemory:
    """The stored calibration of one rig.

    Args:
        devices: name of the devices by their serial numbers, or an empty text where they have none.
        rig: the rig that the source was given, or the factory's calibration.
        folder: the folder of all stored calibrations; None for the user's cache.
    """

    def __init__(self, devices: str, rig: Rig, folder: Path | None = None) -> None:
        self._rig = rig
        self._devices = devices
        self._folder = cache_root() / "calibrations" if folder is None else folder
        digest = hashlib.sha256(to_text(rig, Path("/")).encode()).hexdigest()[:_DIGITS]
        self.path = self._folder / f"{devices or _WITHOUT_SERIALS}.{digest}.yaml"

    @property
    def name(self) -> str:
        """Name of the devices or the rig that the calibration belongs to, for messages."""
        return self._devices or f"the rig {self._rig.name}"

    def recall(self) -> Remembered | None:
        """Return the stored calibration, or None if there is none for this rig.

        Raises:
            RigError: if the stored calibration belongs to another rig file, or cannot be read.
        """
        if not self.path.exists():
            if self._of_other_rigs():
                raise RigError(f"the calibration remembered for {self.name} is of another rig file")
            return None
        rig, saved_s = load_rig(self.path), self.path.stat().st_mtime
        passed_s = max(time.time() - saved_s, 0.0)
        sigmas = widened(rig.calibration_sigmas, self._rig.calibration_sigmas, passed_s)
        return Remembered(replace(rig, calibration_sigmas=sigmas), datetime.fromtimestamp(saved_s))

    def keep(self, odometry: Odometry) -> bool:
        """Store the calibration that a run has estimated, if it has; returns whether it is stored.

        Raises:
            OSError: if it cannot be written; what was stored before is then unchanged.
        """
        estimate = odometry.calibration
        if estimate is None or not any(finding.is_observed for finding in odometry.calibration_findings):
            return False
        if estimate.is_file_exact and estimate.file_rig is self._rig:
            return False
        if estimate.is_file_exact:  # the stored calibration was kept in force; the new estimate is better
            estimate = replace(
                estimate, difference=estimate.posterior.mean, file_factors=np.ones_like(estimate.file_factors)
            )
        self._folder.mkdir(parents=True, exist_ok=True)
        replace_file(self.path, to_text(estimate.rig, self.path.parent))
        for other in self._of_other_rigs():
            other.unlink(missing_ok=True)
        return True

    def forget(self) -> None:
        """Remove the stored calibrations of the devices, for this rig file and for others.

        Raises:
            OSError: if it cannot be removed.
        """
        for path in (self.path, *self._of_other_rigs()):
            path.unlink(missing_ok=True)

    def _of_other_rigs(self) -> list[Path]:
        """List what is stored for the same devices with other rig files; nothing if they have no serial numbers."""
        if not self._devices:
            return []
        found = self._folder.glob("*.yaml") if self._folder.is_dir() else ()
        return [path for path in found if path != self.path and path.name.rsplit(".", 2)[0] == self._devices]


def devices_of(spec: str, source_name: str) -> str | None:
    """Return the name of a live source's devices by their serial numbers, empty where they have none.

    Args:
        spec: text of the source on the command line.
        source_name: name of the opened source.

    Returns:
        The name, or None for recordings, for which nothing is stored: equal input gives equal output there.
    """
    kind = spec.partition(":")[0].partition("?")[0]
    if kind in _NAMED_BY_SERIAL:
        return source_name.replace(os.sep, "_")
    return "" if kind in _NAMED_BY_RIG else None


def widened(sigmas: CalibrationSigmas, of_file: CalibrationSigmas, passed_s: float) -> CalibrationSigmas:
    """Return standard deviations widened by the calibration's random walk over a time, at most to the rig file's."""
    return CalibrationSigmas(
        **{
            name: max(min(float(np.hypot(sigma, WALK * np.sqrt(passed_s) * limit)), limit), sigma)
            for name, sigma, limit in ((name, sigmas.values[name], limit) for name, limit in of_file.values.items())
        },
        estimated=sigmas.estimated,
    )
