"""Angular rates of body by gyro, by vision and by both (the paper's figure 5)."""

from __future__ import annotations

from graphvio.arrays import Float
from graphvio.geometry import se3_inverse, so3_log
from graphvio.measurements.imu_interval import ImuInterval
from graphvio.measurements.motion import RelativeMotion


class AngularRates:
    """Converts successive motions, which may share a reference, into angular rates over the newest interval."""

    def __init__(self) -> None:
        self._before: RelativeMotion | None = None

    def update(
        self, motion: RelativeMotion | None, interval: ImuInterval | None, gyro_bias: Float, fused: Float | None
    ) -> dict[str, Float]:
        """Return rates (3,) rad/s in body by ``gyro``, ``vision`` and ``fused``, as far as known.

        Args:
            motion: measured motion that ends in the newest frameset, or None.
            interval: the IMU readings since the previous frameset, or None.
            gyro_bias: (3,) rad/s.
            fused: (3,) rate by the state estimator, rad/s, or None.
        """
        rates: dict[str, Float] = {}
        if interval is not None:
            rates["gyro"] = interval.mean_rate - gyro_bias
        before, self._before = self._before, motion
        if motion is not None:
            earlier_T_now, since_ns = motion.reference_T_current, motion.reference_stamp_ns
            if before is not None and before.reference_stamp_ns == since_ns:
                earlier_T_now = se3_inverse(before.reference_T_current) @ earlier_T_now
                since_ns = before.stamp_ns
            rates["vision"] = so3_log(earlier_T_now[:3, :3].copy()) / ((motion.stamp_ns - since_ns) * 1e-9)
        if fused is not None:
            rates["fused"] = fused
        return rates
