"""The interface of a state estimator, as the odometry uses it.

`SmootherEstimator` and `FilterEstimator` implement it, and without stereo pairs `MonocularEstimator`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from graphvio.arrays import Float, Int
from graphvio.backend.imu_match import ImuMatch
from graphvio.backend.states import RigState, StateCovariance
from graphvio.measurements.estimate import Status
from graphvio.measurements.gate_result import GateResult
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.inertial_state import InertialState
from graphvio.measurements.motion import LocatedPoints, RelativeMotion, VisualResult


@dataclass(frozen=True, eq=False)
class MeasurementUpdate:
    """What became of a frameset's measurements.

    Attributes:
        motion: The relative motion that constrains the newest state, or None where there is none or it was
            rejected by the gate.
        partial_motion: What few points show of the motion, if it was used; it does not constrain the state by itself.
        needs_keyframe: Whether later motions have to be measured from the newest frameset, because no state is kept
            that they could be measured from otherwise.
    """

    motion: RelativeMotion | None
    partial_motion: RelativeMotion | None = None
    needs_keyframe: bool = False


@dataclass(frozen=True)
class StateUpdate:
    """The outcome of solving for the newest state.

    Attributes:
        status: What the estimate is based on.
        needs_keyframe: As with `MeasurementUpdate`.
        outliers: Of a rig without pairs, camera index -> identities of tracks that do not stand still.
    """

    status: Status
    needs_keyframe: bool = False
    outliers: Mapping[int, Int] = field(default_factory=dict)


class StateEstimator(Protocol):
    """The state of the rig over time (section 5).

    Once for each frameset: `initialise` or `predict`, then `apply` and `update`. Refused measurements, breaks and
    reinitialisations are reported as events to the function that the estimator is made with.

    Attributes:
        epoch: Number of declared breaks until now.
        gate_results: Outcomes of the innovation tests since the last prediction, by the name of what was measured, see
            `graphvio.measurements.estimate.Estimate`.
        initialisations: Number of initialisations and reinitialisations until now; resets of velocities do not count.
    """

    epoch: int
    gate_results: dict[str, GateResult]
    initialisations: int

    @property
    def covariance(self) -> StateCovariance:
        """Covariance of the newest state."""

    @property
    def is_initialised(self) -> bool:
        """Whether there is a state."""

    @property
    def has_pose(self) -> bool:
        """Whether the newest state has a pose. One of single cameras has none until the scale is known."""

    @property
    def has_imu(self) -> bool:
        """Whether there is a state, and it was initialised with an IMU."""

    @property
    def latest_ns(self) -> int:
        """Stamp of the newest state; there must be one."""

    def state(self) -> RigState:
        """Return the newest state; there must be one."""

    def latest_rate(self) -> Float | None:
        """Return the angular rate (3,) rad/s of body over the newest step, or None at an initialisation."""

    def motion_since(self, then_ns: int) -> Float | None:
        """Return ``now_T_then`` (4, 4) of body from an earlier frameset to the newest state, or None if unknown."""

    def covariance_since(self, then_ns: int) -> Float | None:
        """Return the covariance of the motion from an earlier state that was kept to the newest one.

        Returns:
            (6, 6), tangent ``[rotation, translation]`` in the newest body frame, or None if it is not known.
        """

    def located_points(self) -> dict[int, LocatedPoints]:
        """Return the points of known distance that single cameras see at the newest state, by camera.

        Empty where the front-end locates the points.
        """

    def take_final(self) -> list[tuple[int, Float]]:
        """Return stamps and poses ``nav_T_body`` that became final since the last call, not always in time order."""

    def add_sample(self, stamp_ns: int, values: Float) -> None:
        """Add an IMU sample, if single ones are needed beside the intervals between framesets.

        Args:
            stamp_ns: On the framesets' clock.
            values: (6,) angular velocity, rad/s, and specific force, m/s^2.
        """

    def initialise(self, stamp_ns: int, imu: tuple[ImuInterval, float] | None) -> None:
        """Initialise the state at a frameset, with roll and pitch from the IMU if there is one.

        Where there is a state already, which is so when an IMU comes after an initialisation without, a new epoch
        begins at its position.

        Args:
            stamp_ns: Stamp of the frameset.
            imu: The IMU around the frameset, and the frameset's place in that interval in seconds; None initialises
                without an IMU.
        """

    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> bool:
        """Predict the state at the next frameset, from the IMU or by constant velocity (eq. 11, 12).

        Args:
            stamp_ns: Stamp of the frameset.
            interval: The IMU since the newest state; None predicts by constant velocity.

        Returns:
            Whether later motions have to be measured from the frameset before, because the state was reinitialised.
        """

    def apply(self, visual: VisualResult, is_stationary: bool) -> MeasurementUpdate:
        """Test what was measured against the prediction, and insert what passes (section 5).

        A gate that stays closed for too long is itself at fault: the state is then reinitialised.

        Args:
            visual: The front-end's result for the frameset.
            is_stationary: Whether images, and the IMU if there is one, show a standstill.
        """

    def update(self, stamp_ns: int, is_constrained: bool, keep: frozenset[int]) -> StateUpdate:
        """Solve for the newest state and its covariance.

        Args:
            stamp_ns: Stamp of the newest state.
            is_constrained: Whether vision constrains it, or it has just been initialised; `MonocularEstimator` ignores
                it, since its window shows that.
            keep: Stamps of states that later motions will be measured from. If `stamp_ns` is among them, the newest
                frameset is a keyframe; `MonocularEstimator` relies on this.
        """

    def finish(self) -> None:
        """Declare all poses final: no measurement follows."""


@runtime_checkable
class ImuFaultTolerant(Protocol):
    """What a `StateEstimator` has in addition, if it can go on by vision alone while the IMU contradicts vision.

    The odometry watches the IMU of an estimator that has these methods, see `graphvio.odometry.imu_watch`, and the
    self-calibration reports wrong corrections of the IMU to it.
    """

    def leave_imu_out(self) -> None:
        """Record that the IMU is not used until `use_imu_again`: the initialisation no longer waits for it."""

    def use_imu_again(self, motion: RelativeMotion, match: ImuMatch) -> None:
        """Use the IMU again: keep the newest pose, and take biases and gravity from a comparison with vision.

        Args:
            motion: By vision, that ends in the newest state.
            match: How the IMU moves beside vision.
        """

    def use_late_imu(self, motion: RelativeMotion, imu: tuple[ImuInterval, float]) -> None:
        """Use the IMU from now on, after an initialisation without: keep the newest pose, and take gravity from it.

        Args:
            motion: By vision, that ends in the newest state.
            imu: The IMU around the state and the state's place in that interval, seconds.
        """

    def use_inertial_state(self, known: InertialState) -> bool:
        """Go on with velocity, biases and gravity from a keyframe that contradicts the state's.

        Not if they are known much less well, or the keyframe has left the window; nor while the estimate is lost,
        motions are refused, or the IMU is left out. Pose and epoch go on, and no event is reported.

        Args:
            known: At a keyframe, by its frameset's stamp.

        Returns:
            Whether the state was changed, so that later motions have to be measured from the newest frameset.
        """

    def distrust_prediction(self) -> None:
        """Record that the prediction is wrong and refused motions are right: the IMU's calibration was corrected.

        Biases and attitude have followed wrong samples, so that the next reinitialisation gives them wide priors.
        """

    def pose_by_vision(self) -> Float:
        """Return ``nav_T_body`` (4, 4) of the newest state; while motions are refused, the one that they lead to."""
