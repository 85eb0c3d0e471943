"""Merging of IMU samples and framesets in the order in which an estimator needs them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from graphvio.measurements.sensors import FrameSet, ImuSample, Measurement

COVER_NS = 50_000_000
"""A sample that is later than this after a frameset does not cover the frameset: the IMU has a gap there."""


def merge(imu: Iterable[ImuSample], framesets: Iterable[FrameSet], time_offset_ns: int = 0) -> Iterator[Measurement]:
    """Yield all samples and framesets in time order, each frameset after the sample that covers it.

    The covering sample is the first one at or after the frameset's instant on the IMU's clock. In a gap of the IMU and
    after its end there is none, and the frameset is yielded without it. Samples after the last frameset follow it.

    Args:
        imu: samples in time order, IMU clock.
        framesets: framesets in time order, camera clock.
        time_offset_ns: offset to add to a frameset's stamp to get the IMU's stamp of the same instant.
    """
    samples = iter(imu)
    pending = next(samples, None)
    latest_ns: int | None = None
    for frameset in framesets:
        instant_ns = frameset.stamp_ns + time_offset_ns
        while pending is not None and (latest_ns is None or latest_ns < instant_ns):
            if pending.stamp_ns > instant_ns + COVER_NS:
                break
            latest_ns = pending.stamp_ns
            yield pending
            pending = next(samples, None)
        yield frameset
    while pending is not None:
        yield pending
        pending = next(samples, None)
