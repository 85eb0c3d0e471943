"""Runs the odometry over a hard case and holds every motion of its front-end against the truth."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from scipy.stats import chi2, norm

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.events import Estimate, Event, FrameSet, Status
from graphvio.frontend.motion import RelativeMotion, VisualResult
from graphvio.frontend.visual import VisualFrontend
from graphvio.geometry import se3_inverse, se3_log
from graphvio.odometry import Odometry
from graphvio.rig import Rig

FIVE_SIGMA = float(chi2.isf(2.0 * norm.sf(5.0), 6))
"""The squared Mahalanobis distance of six errors that is as rare as one error beyond five standard deviations."""

MATERIAL_M, MATERIAL_DEG = 0.01, 0.2


@dataclass(frozen=True)
class Judged:
    """One motion that the front-end returned.

    Attributes:
        since_s: since the first frameset.
        during: whether it ends while the fault lasts.
        quality: as the front-end says, in lower case: ``good`` or ``weak``.
        accepted: whether the odometry used it.
        nees: squared Mahalanobis distance from the truth, 6 degrees of freedom.
        error_m: of the translation.
        error_deg: of the rotation.
        span_s: from its reference to its end.
        inliers: of each pair.
        points: of each pair, that were offered to the estimation.
    """

    since_s: float
    during: bool
    quality: str
    accepted: bool
    nees: float
    error_m: float
    error_deg: float
    span_s: float
    inliers: dict[int, int]
    points: dict[int, int]

    @property
    def wrong(self) -> bool:
        """Beyond 5 sigma."""
        return not self.nees <= FIVE_SIGMA

    @property
    def materially_wrong(self) -> bool:
        """Beyond 5 sigma, and by more than 1 cm or 0.2 degrees."""
        return self.wrong and (self.error_m > MATERIAL_M or self.error_deg > MATERIAL_DEG)


@dataclass
class Outcome:
    """What came of one run.

    Attributes:
        framesets: that the front-end was given.
        during: those of them in a fault's span.
        failures: reason -> number of framesets without a motion.
        incidents: kind -> number.
        motions: all that were returned.
    """

    framesets: int = 0
    during: int = 0
    failures: Counter[str] = field(default_factory=Counter)
    incidents: Counter[str] = field(default_factory=Counter)
    motions: list[Judged] = field(default_factory=list)

    def add(self, other: Outcome) -> None:
        """Count another run in."""
        self.framesets += other.framesets
        self.during += other.during
        self.failures.update(other.failures)
        self.incidents.update(other.incidents)
        self.motions += other.motions


class Run:
    """An odometry whose front-end is listened to; with the rig's IMU, or on vision alone.

    Args:
        rig: of the recording.
        config: of the odometry.
        with_imu: whether the IMU takes part.
    """

    def __init__(self, rig: Rig, config: Config, *, with_imu: bool) -> None:
        self._with_imu = with_imu
        self._odometry = Odometry(rig if with_imu else rig.without_imu(), config)
        self._listener = _Listener(self._odometry._frontend)
        self._odometry._frontend = cast(VisualFrontend, self._listener)
        self._used: dict[int, bool] = {}
        self._during: dict[int, bool] = {}

    def feed(self, event: Event, during: bool) -> None:
        """Give it an event, and whether a fault lasts."""
        if isinstance(event, FrameSet):
            self._during[event.stamp_ns] = during
        elif not self._with_imu:
            return
        estimate = self._odometry.process(event)
        self._note([estimate] if estimate is not None else [])

    def finish(self, truth: dict[int, Float], start_ns: int) -> Outcome:
        """End the run and judge it by the truth, stamp -> ``world_T_body`` (4, 4)."""
        self._note(self._odometry.finish())
        outcome = Outcome(len(self._listener.results), sum(self._during.values()))
        outcome.incidents.update(incident.kind for incident in self._odometry.take_incidents())
        for stamp_ns, result in self._listener.results:
            quality = getattr(result, "quality", "good")
            quality = str(getattr(quality, "name", quality)).lower()
            if result.motion is None or quality == "failed":
                outcome.failures[re.sub(r"\d+", "N", result.reason) or "no reason given"] += 1
                continue
            nees, error_m, error_deg = errors(result.motion, truth)
            outcome.motions.append(
                Judged(
                    since_s=(stamp_ns - start_ns) * 1e-9,
                    during=self._during[stamp_ns],
                    quality=quality,
                    accepted=self._used.get(stamp_ns, False),
                    nees=nees,
                    error_m=error_m,
                    error_deg=error_deg,
                    span_s=(stamp_ns - result.motion.reference_stamp_ns) * 1e-9,
                    inliers={pair: report.inliers for pair, report in sorted(result.pairs.items())},
                    points={pair: report.points for pair, report in sorted(result.pairs.items())},
                )
            )
        return outcome

    def _note(self, estimates: Iterable[Estimate]) -> None:
        for estimate in estimates:
            self._used[estimate.stamp_ns] = estimate.status in (Status.TRACKING, Status.INITIALISING)


def errors(motion: RelativeMotion, truth: dict[int, Float]) -> tuple[float, float, float]:
    """Squared Mahalanobis distance of a motion from the truth, metres and degrees of its error.

    The error is the tangent ``log(true^-1 measured)``, in the body frame of the later instant as the covariance is.
    """
    true = se3_inverse(truth[motion.reference_stamp_ns]) @ truth[motion.stamp_ns]
    error = se3_log(se3_inverse(true) @ motion.reference_T_current)
    try:
        nees = float(error @ np.linalg.solve(motion.covariance, error))
    except np.linalg.LinAlgError:
        nees = np.inf  # it claims to know something exactly
    if not nees >= 0.0:
        nees = np.inf
    return nees, float(np.linalg.norm(error[3:])), float(np.rad2deg(np.linalg.norm(error[:3])))


class _Listener:
    """Stands before a front-end and keeps all that it returns."""

    def __init__(self, frontend: VisualFrontend) -> None:
        self._frontend = frontend
        self.results: list[tuple[int, VisualResult]] = []

    def process(self, frameset: FrameSet, *arguments: Any, **named: Any) -> VisualResult:
        result = self._frontend.process(frameset, *arguments, **named)
        self.results.append((frameset.stamp_ns, result))
        return result

    def __getattr__(self, name: str) -> Any:
        return getattr(self._frontend, name)
