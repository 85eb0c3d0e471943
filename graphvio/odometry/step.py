"""A step of the odometry with all its inputs, for subscribers such as recorders and SLAM."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from graphvio.arrays import Float, Image
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.measurements.estimate import Estimate
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import LocatedPoints, RelativeMotion


@dataclass(frozen=True, eq=False)
class NewKeyframe:
    """A frameset from which later motions are measured.

    Attributes:
        frames: Index of a pair or single camera -> its tracks.
        images: The same index -> (left, right) of a pair, (image,) of a single camera.
        body_T_left: (P, 4, 4) extrinsics of all left and single cameras, with the corrections that are in force.
        previous_ns: Stamp of the previous keyframe, or None.
        previous_T_body: (4, 4) motion since the previous keyframe, or None if it is not known.
        covariance: (6, 6) covariance of that motion, tangent ``[rotation, translation]`` in body, or None without it.
        located_points: Function, to be called within the step, that returns the points of single cameras that the state
            estimator locates, by camera index.
    """

    frames: Mapping[int, TrackedFrame]
    images: Mapping[int, tuple[Image, ...]]
    body_T_left: Float
    previous_ns: int | None
    previous_T_body: Float | None
    covariance: Float | None
    located_points: Callable[[], Mapping[int, LocatedPoints]] = dict


@dataclass(frozen=True, eq=False)
class Step:
    """The odometry's measurements at a frameset, and the resulting estimate.

    Attributes:
        estimate: The estimate as `graphvio.Odometry.process` returns it.
        motion: The relative motion that constrains the state, or else a refused one of good quality; otherwise None.
        used: Whether the motion passed the gate.
        interval: The IMU readings since the previous step, or None.
        initialised: Whether the state was initialised or reinitialised here: earlier steps no longer constrain it.
        references: Stamps of the framesets that later motions are measured from.
        own: Pair index -> the motion by this pair alone, at the end of a keyframe whose motion is used.
        keyframe: The frameset's data if later motions are measured from it, or None.
        partial_motion: Where there is no motion, the motion by a few points, if it was used; otherwise None.
    """

    estimate: Estimate
    motion: RelativeMotion | None
    used: bool
    interval: ImuInterval | None
    initialised: bool
    references: frozenset[int]
    own: Mapping[int, RelativeMotion]
    keyframe: NewKeyframe | None
    partial_motion: RelativeMotion | None = None
