"""What the solution says of the rig files: how far each pair is from where its file has it, in standard deviations."""

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

MOST_SIGMAS = 3.0
"""A correction that is larger refutes the rig file."""

_PROBABILITY = 0.9973  # of three standard deviations of one unknown
_HELD = 1e-7  # radians and metres: no measurement is that good


@dataclass(frozen=True)
class PairCorrection:
    """How far a pair is from where the rig file has it.

    Attributes:
        pair: its number.
        name: of it, or empty.
        is_held: whether it is no unknown: without an IMU, the first pair is where the rig file has it.
        of: what the distance is of: its ``left camera``; or ``body's origin``, turned and moved with it as one piece,
            where the rig is not known.
        angle_deg: by which it is turned.
        angle_sigma_deg: largest standard deviation of that, over all axes.
        distance_m: by which it is moved.
        distance_sigma_m: largest standard deviation of that, over all directions.
        squared_distance: Mahalanobis, of rotation and translation together, 6 degrees of freedom; None if held.
    """

    pair: int
    name: str
    is_held: bool
    of: str
    angle_deg: float
    angle_sigma_deg: float
    distance_m: float
    distance_sigma_m: float
    squared_distance: float | None

    @property
    def angle_sigmas(self) -> float | None:
        """How many standard deviations the angle is."""
        return None if self.is_held else self.angle_deg / self.angle_sigma_deg

    @property
    def distance_sigmas(self) -> float | None:
        """How many standard deviations the distance is."""
        return None if self.is_held else self.distance_m / self.distance_sigma_m

    @property
    def is_borne_out(self) -> bool:
        """Whether nothing found speaks against the rig file, along any axis."""
        if self.angle_sigmas is None or self.distance_sigmas is None or self.squared_distance is None:
            return True
        is_near = max(self.angle_sigmas, self.distance_sigmas) <= MOST_SIGMAS
        return is_near and self.squared_distance <= chi_square_quantile(_PROBABILITY, 6)


@dataclass(frozen=True)
class OffsetCorrection:
    """What is to be added to the IMU's time offset, and its standard deviation, seconds."""

    offset_s: float
    sigma_s: float

    @property
    def sigmas(self) -> float:
        """How many standard deviations it is."""
        return abs(self.offset_s) / self.sigma_s

    @property
    def is_borne_out(self) -> bool:
        """Whether the rig file's may be right."""
        return self.sigmas <= MOST_SIGMAS


@dataclass(frozen=True)
class SessionCalibration:
    """Of a session's rig file; the offset is None without an IMU."""

    session: str
    pairs: Sequence[PairCorrection]
    offset: OffsetCorrection | None

    @property
    def is_borne_out(self) -> bool:
        """Whether nothing speaks against the rig file."""
        return all(each.is_borne_out for each in self.pairs) and (self.offset is None or self.offset.is_borne_out)


def calibrations(found: Optimization, rigs: Sequence[Rig | None]) -> list[SessionCalibration | None]:
    """Of each session, or None where the calibration was no unknown.

    Args:
        found: the optimisation.
        rigs: as the sessions' files have them, or None where that is not known.
    """
    corrections: Sequence[RigCorrection | None] = found.corrections or [None] * len(found.sessions)
    return [
        None if correction is None else _session(session.record.name, correction, rig)
        for session, correction, rig in zip(found.sessions, corrections, rigs, strict=True)
    ]


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
    by_tangent = np.hstack([-skew(place), np.eye(3)])  # of the place, in directions that the correction turns
    angle_sigma, sigma_m = _largest(covariance[:3, :3]), _largest(by_tangent @ covariance @ by_tangent.T)
    is_held = min(angle_sigma, sigma_m) < _HELD
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
    """Standard deviation along the axis where it is largest."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
