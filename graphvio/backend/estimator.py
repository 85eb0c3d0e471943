"""What is believed of the rig: the interface that the odometry uses, whatever makes the estimate."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from graphvio.arrays import Float
from graphvio.backend.starts import Start
from graphvio.backend.states import RigState, StateCovariance
from graphvio.config import Config
from graphvio.measurements.estimate import Status
from graphvio.measurements.events import Report
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion, VisualResult
from graphvio.rig import Rig

_INITIALISED_WITHIN_S = 2.0  # else it is told why not


class StateEstimator(ABC):
    """The rig's state, from `start` on: for each frameset `predict`, `use` and `update`, in this order.

    Args:
        rig: cameras and IMU.
        config: of all stages.
        report: is told of refused measurements, breaks and starts.
        rekey: is called where later motions must be measured from the newest frameset.

    Attributes:
        epoch: counts declared breaks.
        covariance: of the newest state.
        gate_results: of the tests since the last prediction, see `graphvio.measurements.estimate.Estimate`.
        starts: counts how often it began, be it anew.
    """

    def __init__(self, rig: Rig, config: Config, report: Report, rekey: Callable[[], None]) -> None:
        self.epoch = 0
        self.covariance = StateCovariance(np.zeros((6, 6)))
        self.gate_results: dict[str, GateResult] = {}
        self.starts = 0
        self._rig = rig
        self._config = config
        self._report = report
        self._rekey = rekey
        self._lost = False
        self._unknown_since_ns: int | None = None  # stamp of a start that the first motions have not completed yet
        self._is_completed = False  # whether they had, at the estimate before
        self._is_told = False  # that this takes long
        self._tracked_ns = 0  # stamp of the last state that vision constrains
        self._final: list[tuple[int, Float]] = []

    # ------------------------------------------------------------------ what is known

    @property
    @abstractmethod
    def has_started(self) -> bool:
        """Whether there is a state."""

    @property
    @abstractmethod
    def has_imu(self) -> bool:
        """Whether it has started with an IMU."""

    @property
    @abstractmethod
    def latest_ns(self) -> int:
        """Stamp of the newest state."""

    @abstractmethod
    def state(self) -> RigState:
        """The newest state."""

    @abstractmethod
    def latest_rate(self) -> Float | None:
        """Angular rate (3,) rad/s of body over the newest step, or None at a start."""

    @abstractmethod
    def motion_since(self, then_ns: int) -> Float | None:
        """``now_T_then`` (4, 4) of body from an earlier frameset to the newest state, or None if it is not known."""

    @abstractmethod
    def covariance_since(self, then_ns: int) -> Float | None:
        """Covariance (6, 6) of the motion from a state that was kept to the newest one, tangent ``[rotation,
        translation]`` in the newest body, or None if it is not known."""

    def take_final(self) -> list[tuple[int, Float]]:
        """Stamps and poses ``nav_T_body`` that became final since the last call; not always in time order."""
        taken, self._final = self._final, []
        return taken

    @abstractmethod
    def end(self) -> None:
        """Nothing more will come: all poses are final."""

    # ------------------------------------------------------------------ one frameset

    @abstractmethod
    def start(self, stamp_ns: int, found: tuple[ImuInterval, float] | None) -> None:
        """Begin at a frameset, where the rig is thought to be, with what the IMU says of its attitude.

        Args:
            stamp_ns: of the frameset.
            found: the IMU around it, and its place in there in seconds; None starts without an IMU.
        """

    @abstractmethod
    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> None:
        """Go on to a frameset's instant by the IMU, or without an interval of it by constant velocity."""

    @abstractmethod
    def use(self, visual: VisualResult, at_rest: bool) -> RelativeMotion | None:
        """Test what was measured, and insert what passes; a gate that refuses for too long is itself at fault.

        Args:
            visual: what vision says.
            at_rest: whether vision, and the IMU if there is one, say that the rig stands still.

        Returns:
            The motion by which vision constrains the newest state, or None.
        """

    @abstractmethod
    def update(self, stamp_ns: int, used: bool, keep: frozenset[int]) -> Status:
        """Solve for the newest state, and tell how well it is known.

        Args:
            stamp_ns: of the newest state.
            used: whether vision constrains it, or it is a start.
            keep: stamps of states that later motions will be measured from.
        """

    def _position_to_start_at(self, stamp_ns: int, found: tuple[ImuInterval, float] | None) -> Float:
        """Where a start begins, (3,) in nav: at the newest position if there is one, which ends an epoch."""
        if self.has_started:
            self.epoch += 1
            self._report(stamp_ns, "imu_came", f"the IMU has come: epoch {self.epoch} starts upright")
            return self.state().nav_T_body[:3, 3]
        if self._rig.imu is not None and found is None:
            self._report(stamp_ns, "started_without_imu", "no IMU samples came: vision alone from here")
        return np.zeros(3)

    def _status(self, stamp_ns: int, used: bool, sigma_m: float) -> Status:
        """Status of the newest state, whose position is uncertain by so much since vision was last used."""
        if used:
            return Status.INITIALISING if self._is_initialising(stamp_ns) else Status.TRACKING
        if not self._lost and sigma_m > self._config.smoother.lost_position_sigma_m:
            self._lost = True
            self._report(stamp_ns, "lost", f"position uncertain by {sigma_m:.2f} m since vision was last used")
        return Status.LOST if self._lost else Status.COASTING

    def _note_start(self, start: Start) -> None:
        """After a start in motion, status is ``initialising`` until the first motions have told what it lacks."""
        self.starts += 1
        if not start.is_known:
            self._unknown_since_ns, self._is_completed, self._is_told = start.stamp_ns, False, False

    def _is_initialising(self, stamp_ns: int) -> bool:
        if self._unknown_since_ns is None:
            return False
        after_s = (stamp_ns - self._unknown_since_ns) * 1e-9
        lacking = self._lacking() if after_s else "there is no motion yet"
        was_completed, self._is_completed = self._is_completed, not lacking
        if self._is_completed:
            # With an IMU, the estimate at which attitude and velocity become known is the last that may jump.
            is_over = was_completed or not self.has_imu
            if is_over:
                self._unknown_since_ns = None
            return not is_over
        if after_s > _INITIALISED_WITHIN_S and not self._is_told:
            self._is_told = True
            self._report(stamp_ns, "not_initialised", f"{after_s:.1f} s after the start {lacking}; go on moving")
        return True

    def _lacking(self) -> str:
        """What is not known well enough yet for a start to be over, in words, or nothing."""
        config, known = self._config.initialisation, self.covariance
        if not self.has_imu or known.velocity is None:
            return ""
        nav_R_body = self.state().nav_T_body[:3, :3]
        about_nav = nav_R_body @ known.pose[:3, :3] @ nav_R_body.T
        tilt_deg = np.rad2deg(np.sqrt(np.linalg.eigvalsh(about_nav[:2, :2])[-1]))
        speed_m_s = np.sqrt(np.linalg.eigvalsh(known.velocity)[-1])
        reasons = []
        if tilt_deg > config.tilt_sigma_deg:
            reasons.append(f"roll and pitch are known to {tilt_deg:.1f} deg only")
        if speed_m_s > config.velocity_sigma_m_s:
            reasons.append(f"the velocity to {speed_m_s:.2f} m/s only")
        return " and ".join(reasons)
