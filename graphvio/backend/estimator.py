"""The interface of a state estimator, as the odometry uses it.

`SmootherEstimator` and `FilterEstimator` implement it, and `MonocularEstimator` for rigs without stereo pairs.
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
    """The outcome of the update with a frameset's measurements.

    Attributes:
        motion: The relative motion that constrains the newest state, or None where there is none or it was
            rejected by the gate.
        partial_motion: The motion by a few points, if it was used; it does not constrain the state by itself.
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
        needs_keyframe: As in `MeasurementUpdate`.
        outliers: For a rig without stereo pairs, camera index -> identities of tracks of points that move.
    """

    status: Status
    needs_keyframe: bool = False
    outliers: Mapping[int, Int] = field(default_factory=dict)


class StateEstimator(Protocol):
    """An estimator of the rig's state over time (section 5).

    It is called once for each frameset: `initialise` or `predict`, then `apply` and `update`. It reports refused
    measurements, breaks and reinitialisations as events to a function that is passed to its constructor.

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
        """Whether the newest state has a pose. With single cameras only, it has none until the scale is known."""

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
        """Return, by camera index, the points of known distance that single cameras see at the newest state.

        Empty for estimators that leave the location of points to the front-end.
        """

    def take_final(self) -> list[tuple[int, Float]]:
        """Return stamps and poses ``nav_T_body`` that became final since the last call, not always in time order."""

    def add_sample(self, stamp_ns: int, values: Float) -> None:
        """Add an IMU sample, for estimators that need single samples beside the intervals between framesets.

        Args:
            stamp_ns: Stamp of the sample on the framesets' clock.
            values: (6,) angular velocity, rad/s, and specific force, m/s^2.
        """

    def initialise(self, stamp_ns: int, imu: tuple[ImuInterval, float] | None) -> None:
        """Initialise the state at a frameset, with roll and pitch from the IMU if there is one.

        The paper's filter is also called with a state, when the first IMU samples come after an initialisation without
        an IMU: a new epoch then begins at the state's position.

        Args:
            stamp_ns: Stamp of the frameset.
            imu: The IMU readings around the frameset, and the frameset's time in that interval, seconds; None
                initialises without an IMU.
        """

    def predict(self, stamp_ns: int, interval: ImuInterval | None) -> bool:
        """Predict the state at the next frameset, from the IMU or by constant velocity (eq. 11, 12).

        Args:
            stamp_ns: Stamp of the frameset.
            interval: The IMU readings since the newest state; None predicts by constant velocity.

        Returns:
            Whether later motions have to be measured from the previous frameset, because the state was reinitialised.
        """

    def apply(self, visual: VisualResult, is_stationary: bool) -> MeasurementUpdate:
        """Test the measurements against the prediction, and insert those that pass (section 5).

        If motions are refused for too long, the prediction is considered wrong, and the state is reinitialised.

        Args:
            visual: The front-end's result for the frameset.
            is_stationary: Whether images, and the IMU if there is one, show a standstill.
        """

    def update(self, stamp_ns: int, is_constrained: bool, keep: frozenset[int]) -> StateUpdate:
        """Solve for the newest state and its covariance.

        Args:
            stamp_ns: Stamp of the newest state.
            is_constrained: Whether vision constrains the state, or it has just been initialised; `MonocularEstimator`
                ignores this argument, since its window shows it.
            keep: Stamps of states that later motions will be measured from. If `stamp_ns` is among them, the newest
                frameset is a keyframe; `MonocularEstimator` relies on this.
        """

    def finish(self) -> None:
        """Declare all poses final: no measurement follows."""


@runtime_checkable
class ImuFaultTolerant(Protocol):
    """Additional methods of a `StateEstimator` that can go on by vision alone while the IMU contradicts vision.

    If an estimator has these methods, the odometry compares the IMU with vision, see `graphvio.odometry.imu_watch`, and
    the self-calibration reports wrong corrections of the IMU's calibration to the estimator.
    """

    def leave_imu_out(self) -> None:
        """Stop using the IMU until `use_imu_again`: meanwhile, the initialisation does not wait for it."""

    def use_imu_again(self, motion: RelativeMotion, match: ImuMatch) -> None:
        """Use the IMU again: keep the newest pose, and take biases and gravity from a comparison with vision.

        Args:
            motion: A motion by vision that ends in the newest state.
            match: Result of the comparison of the IMU with vision.
        """

    def use_late_imu(self, motion: RelativeMotion, imu: tuple[ImuInterval, float]) -> None:
        """Use the IMU from now on, after an initialisation without it: keep the newest pose, and take gravity from it.

        Args:
            motion: A motion by vision that ends in the newest state.
            imu: The IMU readings around the state, and the state's time in that interval, seconds.
        """

    def use_inertial_state(self, known: InertialState) -> bool:
        """Replace velocity, biases and gravity by those known at a keyframe, if the state's contradict these.

        Nothing is changed if the keyframe's values are known much less well or it has left the window, nor while the
        estimate is lost, motions are refused, or the IMU is left out. Pose and epoch go on, and no event is reported.

        Args:
            known: Velocity, biases and gravity at a keyframe, which its frameset's stamp identifies.

        Returns:
            Whether the state was changed, so that later motions have to be measured from the newest frameset.
        """

    def distrust_prediction(self) -> None:
        """Record that the prediction is wrong and refused motions are right: the IMU's calibration was corrected.

        Biases and attitude have followed wrong samples, so that the next reinitialisation gives them wide priors.
        """

    def pose_by_vision(self) -> Float:
        """Return ``nav_T_body`` (4, 4) of the newest state; while motions are refused, the pose that these lead to."""
