"""The estimated calibration compared with the rig files, in standard deviations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.gating import chi_square_quantile
from graphvio.geometry import se3_log, skew, so3_log
from graphvio.optimization.extrinsics import RigCorrection
from graphvio.optimization.optimize import Optimization
from graphvio.rig import Rig

MAX_SIGMAS = 3.0
"""Largest correction, in standard deviations, that is consistent with the rig file."""

_PROBABILITY = 0.9973  # within three standard deviations of one unknown
_FIXED = 1e-7  # radians and metres: a smaller standard deviation is that of a fixed value, not of a measurement


@dataclass(frozen=True)
class PairCorrection:
    """The correction of a pair's extrinsics."""

    pair: int  # number of the pair
    name: str  # name of the pair, or empty
    is_held: bool  # whether the pair is held fixed: without an IMU, the first pair defines body
    # point whose displacement is given: the pair's ``left camera``, or ``body's origin`` moved with the pair if the rig
    # is unknown
    of: str
    angle_deg: float  # angle of the correction's rotation
    angle_sigma_deg: float  # its standard deviation, largest over all axes
    distance_m: float  # displacement of the point
    distance_sigma_m: float  # its standard deviation, largest over all directions
    # squared Mahalanobis distance of rotation and translation, 6 degrees of freedom; None if held
    squared_distance: float | None

    @property
    def title(self) -> str:
        """The pair's number, and its name if known."""
        return f"pair {self.pair} ({self.name})" if self.name else f"pair {self.pair}"

    @property
    def angle_sigmas(self) -> float | None:
        """The angle in standard deviations."""
        return None if self.is_held else self.angle_deg / self.angle_sigma_deg

    @property
    def distance_sigmas(self) -> float | None:
        """The displacement in standard deviations."""
        return None if self.is_held else self.distance_m / self.distance_sigma_m

    @property
    def is_consistent(self) -> bool:
        """Whether the correction is consistent with the rig file: rotation and displacement, each and together."""
        if self.angle_sigmas is None or self.distance_sigmas is None or self.squared_distance is None:
            return True
        is_near = max(self.angle_sigmas, self.distance_sigmas) <= MAX_SIGMAS
        return is_near and self.squared_distance <= chi_square_quantile(_PROBABILITY, 6)

    @property
    def conclusion(self) -> str:
        """The comparison with the rig file in words."""
        return "held at the rig file's value" if self.is_held else _conclusion(self.is_consistent)


@dataclass(frozen=True)
class OffsetCorrection:
    """The correction of the IMU's time offset and its standard deviation, in seconds."""

    offset_s: float
    sigma_s: float

    @property
    def sigmas(self) -> float:
        """The correction in standard deviations."""
        return abs(self.offset_s) / self.sigma_s

    @property
    def is_consistent(self) -> bool:
        """Whether the correction is consistent with the rig file."""
        return self.sigmas <= MAX_SIGMAS

    @property
    def conclusion(self) -> str:
        """The comparison with the rig file in words."""
        return _conclusion(self.is_consistent)


@dataclass(frozen=True)
class SessionCalibration:
    """The corrections of a session's rig file; no offset without an IMU."""

    session: str
    pairs: Sequence[PairCorrection]
    offset: OffsetCorrection | None

    @property
    def is_consistent(self) -> bool:
        """Whether all corrections are consistent with the rig file."""
        return all(each.is_consistent for each in self.pairs) and (self.offset is None or self.offset.is_consistent)

    def lines(self) -> list[str]:
        """Describe the corrections: a line for each pair, and one for the time offset."""
        lines = []
        for pair in self.pairs:
            line = pair.title
            if not pair.is_held:
                distance_mm, sigma_mm = 1e3 * pair.distance_m, 1e3 * pair.distance_sigma_m
                line += (
                    f": turned by {pair.angle_deg:.3f} degrees (sigma {pair.angle_sigma_deg:.3f}: "
                    f"{pair.angle_sigmas:.1f} sigmas), {pair.of} moved by {distance_mm:.2f} mm (sigma {sigma_mm:.2f}: "
                    f"{pair.distance_sigmas:.1f} sigmas)"
                )
            lines.append(f"{line}: {pair.conclusion}")
        if self.offset is not None:
            offset_ms, sigma_ms = 1e3 * self.offset.offset_s, 1e3 * self.offset.sigma_s
            lines.append(
                f"time offset {offset_ms:+.2f} ms (sigma {sigma_ms:.2f} ms: {self.offset.sigmas:.1f} sigmas): "
                f"{self.offset.conclusion}"
            )
        return lines


def calibrations(found: Optimization, rigs: Sequence[Rig | None]) -> list[SessionCalibration | None]:
    """Compare the calibration of each session, where it was estimated, with its rig file, if that is known."""
    corrections: Sequence[RigCorrection | None] = found.corrections or [None] * len(found.sessions)
    return [
        None if correction is None else _session(session.record.name, correction, rig)
        for session, correction, rig in zip(found.sessions, corrections, rigs, strict=True)
    ]


def _conclusion(is_consistent: bool) -> str:
    return "consistent with the rig file" if is_consistent else "contradicts the rig file"


def _session(name: str, correction: RigCorrection, rig: Rig | None) -> SessionCalibration:
    offset = None
    if correction.offset_sigma_s:
        offset = OffsetCorrection(correction.offset_s, correction.offset_sigma_s)
    pairs = [
        _pair(pair, correction.pairs[pair], correction.covariances[pair], rig) for pair in sorted(correction.pairs)
    ]
    return SessionCalibration(name, pairs, offset)


def _pair(pair: int, correction: Float, covariance: Float, rig: Rig | None) -> PairCorrection:
    known = None if rig is None or pair >= len(rig.pairs) else rig.pairs[pair]
    place = np.zeros(3) if known is None else np.ascontiguousarray(known.left.body_T_cam[:3, 3])
    rotation = np.ascontiguousarray(correction[:3, :3])
    moved_m = float(np.linalg.norm(rotation @ place + correction[:3, 3] - place))
    by_tangent = np.hstack([-skew(place), np.eye(3)])  # displacement of the place by the tangent
    angle_sigma, sigma_m = _largest(covariance[:3, :3]), _largest(by_tangent @ covariance @ by_tangent.T)
    is_held = min(angle_sigma, sigma_m) < _FIXED
    tangent = se3_log(np.ascontiguousarray(correction))
    return PairCorrection(
        pair,
        "" if known is None else known.name,
        is_held,
        "body's origin" if known is None else "left camera",
        math.degrees(float(np.linalg.norm(so3_log(rotation)))),
        math.degrees(angle_sigma),
        moved_m,
        sigma_m,
        None if is_held else float(tangent @ np.linalg.lstsq(covariance, tangent, rcond=None)[0]),
    )


def _largest(covariance: Float) -> float:
    """Compute the standard deviation along the axis where it is largest."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
