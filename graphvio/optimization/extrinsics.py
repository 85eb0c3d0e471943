"""The rig's calibration as variables of the graph: extrinsics of each pair, and the IMU's time offset.

If a pair's true ``body_T_left`` is ``C`` times that of the rig file, the pair measures a motion ``M`` of body as
``C^-1 M C``, see `graphvio.frontend.pairs.extrinsic_monitor`. If its images were taken ``d`` seconds later on the IMU's
clock than the rig file states, it sees body at the pose ``x exp(d xi)``, with the twist ``xi`` of body.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from graphvio.arrays import Float
from graphvio.backend.factors import x
from graphvio.backend.noise import gaussian, isotropic
from graphvio.geometry import se3_adjoint, se3_compose, se3_exp, se3_inverse, se3_log
from graphvio.measurements.motion import RelativeMotion
from graphvio.optimization.solver import Marginals
from graphvio.rig import Rig

_FIRST_SIGMAS = np.repeat([0.02, 0.005], 3)  # prior of the first pair's pose relative to the IMU: radians, metres
_OTHER_SIGMAS = np.repeat([0.05, 0.05], 3)
_OFFSET_SIGMA_S = 0.02


def c(session: int, pair: int) -> int:
    """Return the key of a pair's correction, by which its ``body_T_left`` is multiplied from the left."""
    return int(gtsam.symbol("c", 256 * session + pair))


def d(session: int) -> int:
    """Return the key of the correction of a session's time offset, in seconds."""
    return int(gtsam.symbol("d", session))


@dataclass(frozen=True, eq=False)
class RigCorrection:
    """Corrections of a session's rig file."""

    pairs: dict[int, Float]  # pair -> correction (4, 4), by which its ``body_T_left`` is multiplied from the left
    # pair -> covariance (6, 6) of the correction, tangent ``[rotation, translation]``; about zero for the first pair if
    # there is no IMU
    covariances: dict[int, Float]
    offset_s: float  # added to the IMU's time offset
    offset_sigma_s: float | None  # its standard deviation, or None without an IMU

    def corrected(self, rig: Rig) -> Rig:
        """Return a rig with these corrections applied."""
        pairs = []
        for j, pair in enumerate(rig.pairs):
            correction = self.pairs.get(j, np.eye(4))
            left, right = (
                replace(camera, body_T_cam=correction @ camera.body_T_cam) for camera in (pair.left, pair.right)
            )
            pairs.append(replace(pair, left=left, right=right))
        imu = rig.imu
        if imu is not None and self.offset_sigma_s is not None:
            imu = replace(imu, time_offset_s=imu.time_offset_s + self.offset_s)
        return replace(rig, pairs=tuple(pairs), imu=imu)


def unknowns(session: int, pairs: int, with_imu: bool) -> Iterator[tuple[int, Any, gtsam.NonlinearFactor]]:
    """Yield key, initial value and prior of each variable; without an IMU, a tight prior fixes the first pair."""
    for pair in range(pairs):
        sigmas = _FIRST_SIGMAS if pair == 0 else _OTHER_SIGMAS
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas if with_imu or pair else np.full(6, 1e-9))
        yield c(session, pair), gtsam.Pose3(), gtsam.PriorFactorPose3(c(session, pair), gtsam.Pose3(), noise)
    if with_imu:
        prior = gtsam.PriorFactorVector(d(session), np.zeros(1), isotropic(1, _OFFSET_SIGMA_S))
        yield d(session), np.zeros(1), prior


def own_motion(
    session: int, pair: int, i: int, j: int, motion: RelativeMotion, twists: tuple[Float, Float] | None
) -> gtsam.NoiseModelFactor:
    """Return the factor of a motion of body from state ``i`` to ``j``, measured by one pair with the rig file.

    ``twists`` are body's angular and linear velocities (6,) at both states; None without an IMU.
    """
    keys = [x(i), x(j), c(session, pair)] + ([] if twists is None else [d(session)])
    return gtsam.CustomFactor(gaussian(motion.covariance), keys, _error(motion.reference_T_current, twists))


def correction_of(marginals: Marginals, values: gtsam.Values, session: int, pairs: int) -> RigCorrection:
    """Return the corrections of a session's rig file from the solution."""
    has_offset = values.exists(d(session))
    return RigCorrection(
        {pair: values.atPose3(c(session, pair)).matrix() for pair in range(pairs)},
        {pair: marginals.variable(c(session, pair)) for pair in range(pairs)},
        float(values.atVector(d(session))[0]) if has_offset else 0.0,
        float(np.sqrt(marginals.variable(d(session))[0, 0])) if has_offset else None,
    )


def _error(measured: Float, twists: tuple[Float, Float] | None) -> Callable[..., Float]:
    """Return the error ``log(measured^-1 C^-1 exp(-d xi_i) x_i^-1 x_j exp(d xi_j) C)`` with its derivatives."""
    inverse = se3_inverse(measured)

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, derivatives: list[Float] | None) -> Float:
        """Return the error, and write its derivatives where gtsam asks for them."""
        keys = factor.keys()
        then, now, correction = (values.atPose3(key).matrix() for key in keys[:3])
        before, after = correction, correction
        if twists is not None:
            late_s = float(values.atVector(keys[3])[0])
            before, after = (se3_compose(se3_exp(late_s * twist), correction) for twist in twists)
        motion = se3_compose(se3_compose(se3_inverse(then), now), after)
        seen = se3_compose(se3_inverse(before), motion)
        residual = se3_log(se3_compose(inverse, seen))
        if derivatives is not None:
            left = gtsam.Pose3.LogmapDerivative(residual)
            from_then, from_now = se3_adjoint(se3_inverse(motion)), se3_adjoint(se3_inverse(after))
            derivatives[0] = np.asfortranarray(-left @ from_then)
            derivatives[1] = np.asfortranarray(left @ from_now)
            derivatives[2] = np.asfortranarray(left @ (np.eye(6) - se3_adjoint(se3_inverse(seen))))
            if twists is not None:
                change = from_now @ twists[1] - from_then @ twists[0]
                derivatives[3] = np.asfortranarray((left @ change)[:, None])
        return residual

    return error
