"""Calibration of a rig from a whole recording by self-calibration, with a comparison of the recording's two halves."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby

import numpy as np
from scipy.special import chdtrc

from graphvio.arrays import Float
from graphvio.calibration_sigmas import CalibrationSigmas
from graphvio.config import Config
from graphvio.config.stages import CalibrationConfig
from graphvio.errors import CalibrationError
from graphvio.measurements.sensors import FrameSet, Measurement
from graphvio.odometry.imu_clock import with_late_clock
from graphvio.odometry.odometry import Odometry
from graphvio.rig import Rig
from graphvio.self_calibration.batch import Batch, calibrate_windows, difference_of
from graphvio.self_calibration.collector import FullWindow
from graphvio.self_calibration.curves import Curve, curves_of
from graphvio.self_calibration.evidence import FilePrior
from graphvio.self_calibration.findings import SCALE_MOTION, Finding, findings
from graphvio.self_calibration.parameters import RigCalibration
from graphvio.self_calibration.prior import file_prior

_CAMERAS = ("focal_share", "principal_point_px", "distortion_share")
_STEREO = ("stereo_rotation_deg", "stereo_baseline_share")
_IMU = ("body_rotation_deg", "body_translation_m", "time_offset_s", "imu_scale_share", "imu_misalignment_deg")
GROUPS: dict[str, tuple[str, ...]] = {
    "cameras": _CAMERAS, "stereo": _STEREO, "imu": _IMU, "all": tuple(CalibrationSigmas().values),
}  # fmt: skip
"""Name of what can be calibrated -> names of its parameters' standard deviations, see `CalibrationSigmas`."""
_FIXED = {"cameras": _STEREO, "stereo": _CAMERAS, "imu": _CAMERAS + _STEREO, "all": ()}
"""Name of what is calibrated -> parameters that are fixed meanwhile. The poses of pairs and IMU are estimated as well:
errors of their extrinsics would otherwise be attributed to the cameras."""

Progress = Callable[[str, int, int], None]
"""Callback that receives the stage, the amount of work done in it, and the total amount."""

_FIXED_SHARE = 1e-3  # factor on the standard deviations of parameters that are kept as in the file
_MIN_WINDOWS = 2
_MIN_OF_HALVES = 4
_CHANCE = 1e-3  # probability that halves that agree are reported as disagreeing


@dataclass(frozen=True)
class HalfComparison:
    """The agreement of two halves of a recording in one group of parameters.

    Attributes:
        group: name of the group, as in `graphvio.self_calibration.curves`.
        statistic: squared Mahalanobis distance, about as large as ``dimension`` where they agree.
        dimension: number of parameters.
        size: largest difference, in ``unit``.
        unit: unit of ``size``.
    """

    group: str
    statistic: float
    dimension: int
    size: float
    unit: str

    @property
    def is_good(self) -> bool:
        """Whether chance explains the difference."""
        return bool(chdtrc(self.dimension, self.statistic) > _CHANCE)


@dataclass(frozen=True, eq=False)
class RecordedCalibration:
    """A rig's calibration from a recording.

    Attributes:
        what: one of `GROUPS`.
        file_rig: the rig of the rig file.
        batch: calibration from all windows.
        halves: calibrations from the windows of the first and of the second half, or None for a short recording, or if
            the comparison was not requested.
        end_ns: stamp of the last frameset.
        is_file_exact: whether the odometry found nothing that contradicts the rig file.
        all_findings: the odometry's findings for all parts, with none kept as in the file.
        clock_shift_s: time by which the IMU's stamps are late beyond what the calibration of its time offset corrects.
    """

    what: str
    file_rig: Rig
    batch: Batch
    halves: tuple[Batch, Batch] | None
    end_ns: int
    is_file_exact: bool
    all_findings: list[Finding]
    clock_shift_s: float = 0.0

    @cached_property
    def rig(self) -> Rig:
        """The calibrated rig with its standard deviations; all other parameters are those of the file."""
        refined = with_late_clock(self.batch.estimate.rig, self.clock_shift_s)
        if self.what == "all":
            return refined
        of_file, found = RigCalibration.of(self.file_rig), RigCalibration.of(refined)
        if self.what == "cameras":
            written = of_file._replace(intrinsics=found.intrinsics, distortion=found.distortion)
        elif self.what == "stereo":
            written = of_file._replace(right_T_left=found.right_T_left)
        else:
            moved = found.body_T_left[0] @ np.linalg.inv(of_file.body_T_left[0])
            written = of_file._replace(body_T_left=moved @ of_file.body_T_left)
        known = {name: getattr(refined.calibration_sigmas, name) for name in GROUPS[self.what]}
        return replace(
            written.applied_to(self.file_rig),
            imu=refined.imu if self.what == "imu" else self.file_rig.imu,
            calibration_sigmas=replace(self.file_rig.calibration_sigmas, **known),
        )

    @cached_property
    def findings(self) -> list[Finding]:
        """The findings for each part that was calibrated."""
        of_file, of_others = (prior.covariance for prior in self._priors)
        both = zip(findings(self.batch.estimate, of_file), findings(self.batch.estimate, of_others), strict=True)
        return [found for found, other in both if (other.file_sigmas < 0.5 * found.file_sigmas).all()]

    @property
    def contradicted(self) -> list[Finding]:
        """Findings for parts that are kept as in the file although the recording contradicts it there."""
        parts = {found.part for found in self.findings}
        return [found for found in self.all_findings if found.is_significant and found.part not in parts]

    @property
    def remarks(self) -> list[str]:
        """Remarks on errors other than those of the calibration's parts, a sentence each."""
        if not self.clock_shift_s:
            return []
        return [
            f"IMU, clock: stamps are {1e3 * self.clock_shift_s:.1f} ms late, beyond the time offset of the rig file"
        ]

    @property
    def is_consistent(self) -> bool:
        """Whether the halves agree, so that errors of fixed parameters do not show in the others; True for ``all``."""
        return self.what == "all" or all(each.is_good for each in self.agreements)

    @property
    def is_complete(self) -> bool:
        """Whether the recording determines every calibrated part, except lengths, which hardly any recording does."""
        return all(found.is_observed or found.motion == SCALE_MOTION for found in self.findings)

    @cached_property
    def agreements(self) -> list[HalfComparison]:
        """The agreement of the halves in each group of parameters; empty without halves."""
        if self.halves is None:
            return []
        difference, covariance = difference_of(*self.halves)
        grouped = [list(group) for _, group in groupby(self.curves, lambda curve: curve.group)]
        return [_comparison(curves, difference, covariance) for curves in grouped]

    @cached_property
    def curves(self) -> list[Curve]:
        """The parameters that were calibrated, in units for display."""
        of_file, of_others = (prior.covariance for prior in self._priors)
        return [c for c in curves_of(self.file_rig) if c.row @ of_others @ c.row < 0.25 * (c.row @ of_file @ c.row)]

    @property
    def _priors(self) -> tuple[FilePrior, FilePrior]:
        """Prior of the rig file, and the same prior with the parameters that are calibrated nearly fixed."""
        known = _with_fixed(self.file_rig, GROUPS[self.what])
        return file_prior(self.file_rig), file_prior(known)


def calibrate_recording(
    measurements: Iterable[Measurement],
    rig: Rig,
    what: str = "all",
    config: Config | None = None,
    on_progress: Progress = lambda *_: None,
    compares_halves: bool = True,
) -> RecordedCalibration:
    """Run the odometry over a recording, and calibrate its rig from all windows of the self-calibration.

    Args:
        measurements: measurements of the recording, in time order.
        rig: the rig of the rig file; its standard deviations are the prior.
        what: one of `GROUPS`; other parameters are kept as in the file.
        config: configuration of the odometry.
        on_progress: called with the progress of the work.
        compares_halves: whether the two halves of the recording are also calibrated separately.

    Returns:
        The calibrated rig, and the findings for each part of its calibration.

    Raises:
        CalibrationError: if the rig cannot be calibrated in this way, or hardly moved.
        RigError: if the stereo extrinsics are to be calibrated, and there is no pair.
    """
    if what == "stereo":
        rig.need_pairs("the calibration of left to right")
    if what == "imu" and rig.imu is None:
        raise CalibrationError(f"{rig.name} has no IMU to calibrate")
    odometry = Odometry(rig, calibrating(config or Config()))
    windows = CalibrationWindows(odometry)
    count = end_ns = 0
    for measurement in measurements:
        odometry.process(measurement)
        if isinstance(measurement, FrameSet):
            count, end_ns = count + 1, measurement.stamp_ns
            on_progress("odometry", count, 0)
    odometry.finish()
    return windows.calibrate(what, end_ns, on_progress, compares_halves)


def calibrating(config: Config) -> Config:
    """Return the configuration of an odometry that estimates the calibration.

    Raises:
        CalibrationError: if such an odometry cannot estimate the calibration.
    """
    config = replace(config, calibration=CalibrationConfig(online=True))
    if not config.estimates_calibration:
        raise CalibrationError(f"motion.reference is {config.motion.reference}: calibration wants tracks of keyframes")
    return config


class CalibrationWindows:
    """Collects all windows of an odometry's self-calibration, from which the recording's rig is calibrated.

    Args:
        odometry: odometry that estimates the calibration, see `calibrating`, and has processed nothing yet.
    """

    def __init__(self, odometry: Odometry) -> None:
        self._odometry = odometry
        self._windows: list[FullWindow] = []
        odometry.on_full_window(self._windows.append)

    def calibrate(
        self, what: str, end_ns: int, on_progress: Progress = lambda *_: None, compares_halves: bool = True
    ) -> RecordedCalibration:
        """Calibrate the rig when the odometry has finished.

        Args:
            what: one of `GROUPS`.
            end_ns: stamp of the last frameset.
            on_progress: called with the progress of the work.
            compares_halves: whether the two halves of the recording are also calibrated separately.

        Raises:
            CalibrationError: if the rig hardly moved, or its calibration changed.
        """
        rig, windows = self._odometry.rig, self._windows
        if len(windows) < _MIN_WINDOWS:
            raise CalibrationError(
                f"the images hardly move, or are not tracked: {len(windows)} windows of keyframes, and at least "
                f"{_MIN_WINDOWS} are wanted; walk for half a minute with turns, near textured surfaces"
            )
        prior_rig = _with_fixed(rig, _FIXED[what])
        online = self._odometry.calibration
        assert online is not None, "the configuration asks for it"
        judged = end_ns, online.is_file_exact, self._odometry.calibration_findings, self._odometry.clock_shift_s
        mean = online.posterior.mean
        batch = calibrate_windows(prior_rig, windows, mean, lambda k, n: on_progress("all windows", k, n))
        if sum(batch.left_out) > len(windows) // 2:
            raise CalibrationError(
                f"{sum(batch.left_out)} of {len(windows)} windows contradict the others, or fit no calibration: did it "
                "change on the way, or is what is kept as in the file wrong (--what all)?"
            )
        if len(windows) < _MIN_OF_HALVES or not compares_halves:
            return RecordedCalibration(what, rig, batch, None, *judged)
        middle, mean = len(windows) // 2, batch.estimate.posterior.mean
        first = calibrate_windows(prior_rig, windows[:middle], mean, lambda k, n: on_progress("first half", k, n))
        second = calibrate_windows(prior_rig, windows[middle:], mean, lambda k, n: on_progress("second half", k, n))
        return RecordedCalibration(what, rig, batch, (first, second), *judged)


def _with_fixed(rig: Rig, names: Sequence[str]) -> Rig:
    """Return a rig with some of its standard deviations reduced, so that these parameters are nearly fixed."""
    sigmas = rig.calibration_sigmas
    return replace(
        rig, calibration_sigmas=replace(sigmas, **{name: _FIXED_SHARE * getattr(sigmas, name) for name in names})
    )


def _comparison(curves: list[Curve], difference: Float, covariance: Float) -> HalfComparison:
    rows = np.array([curve.row for curve in curves])
    found, spread = rows @ difference, rows @ covariance @ rows.T
    statistic = float(found @ np.linalg.solve(spread, found))
    return HalfComparison(curves[0].group, statistic, len(curves), float(np.abs(found).max()), curves[0].unit)
