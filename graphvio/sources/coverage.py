"""Detection of faults in a recording's index: images without partner, missing pairs, and gaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphvio.arrays import Bool, Int
from graphvio.measurements.events import EventKind
from graphvio.rig import Rig
from graphvio.sources.faults import FaultLog
from graphvio.sources.matching import FramesetIndex, PairIndex

_FRAME_GAP_PERIODS = 1.5
_ABSENT_PERIODS = 0.75
_IMU_GAP_PERIODS = 5.0


def count_image_faults(rig: Rig, pairs: Sequence[PairIndex], framesets: FramesetIndex, faults: FaultLog) -> None:
    """Count images with no or several partners, framesets that lack a pair, and gaps, from first to last frameset."""
    begin_ns, end_ns = int(framesets.stamps_ns[0]), int(framesets.stamps_ns[-1])
    gaps: list[tuple[int, int, str]] = []
    for number, (pair, index) in enumerate(zip(rig.groups, pairs, strict=True)):
        for camera, other, alone in (
            (pair.cameras[0], pair.cameras[-1], index.left_alone),
            (pair.cameras[-1], pair.cameras[0], index.right_alone),
        ):
            alone = alone[(alone >= begin_ns) & (alone <= end_ns)]
            if len(alone):
                within = f"within {1e-6 * index.tolerance_ns:.3g} ms"
                detail = f"{camera.name} has an image at {alone[0]}, {other.name} has none {within}"
                faults.add(EventKind.UNPAIRED_IMAGE, int(alone[0]), detail, len(alone))
        ambiguous = index.ambiguous[(index.ambiguous >= begin_ns) & (index.ambiguous <= end_ns)]
        if len(ambiguous):
            detail = f"{pair.name} has several images within {1e-6 * index.tolerance_ns:.3g} ms of {ambiguous[0]}"
            faults.add(
                EventKind.PAIRING_AMBIGUOUS, int(ambiguous[0]), f"{detail}; the nearest are taken", len(ambiguous)
            )
        absent = framesets.stamps_ns[framesets.rows[:, number, 0] < 0]
        absent = absent[_far_from(absent, index.stamps_ns, _ABSENT_PERIODS)]  # not pairs triggered at another time
        if len(absent):
            detail = f"{pair.name} has no images at {absent[0]}, others have"
            faults.add(EventKind.FRAMESET_INCOMPLETE, int(absent[0]), detail, len(absent))
        inside = (index.stamps_ns >= begin_ns) & (index.stamps_ns <= end_ns)
        for begin, end in _gaps(index.stamps_ns[inside], _FRAME_GAP_PERIODS):
            gaps.append((begin, end, f"{pair.name} has no images for {_ms(end - begin)} after {begin}"))
    last_end = begin_ns
    for begin, end, detail in sorted(gaps):
        if begin >= last_end:  # a gap that several pairs share counts once
            faults.add(EventKind.FRAME_GAP, begin, detail)
        last_end = max(last_end, end)


def count_imu_faults(stamps_ns: Int, begin_ns: int, end_ns: int, faults: FaultLog) -> None:
    """Count gaps in the stamps (N,), N > 0, of the IMU, and a late begin or early end; all on the IMU's clock."""
    period = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0
    if stamps_ns[0] > begin_ns + period:
        detail = f"the first sample comes {_ms(int(stamps_ns[0]) - begin_ns)} after the first frameset"
        faults.add(EventKind.IMU_BEGINS_LATE, int(stamps_ns[0]), detail)
    if stamps_ns[-1] < end_ns - period:
        detail = f"the last sample comes {_ms(end_ns - int(stamps_ns[-1]))} before the last frameset"
        faults.add(EventKind.IMU_STOPS_EARLY, int(stamps_ns[-1]), detail)
    for before, after in _gaps(stamps_ns, _IMU_GAP_PERIODS):
        faults.add(EventKind.IMU_GAP, before, f"no samples for {_ms(after - before)} after {before}")


def _gaps(stamps_ns: Int, periods: float) -> list[tuple[int, int]]:
    """Return the stamps before and after each gap that is longer than ``periods`` median periods."""
    steps = np.diff(stamps_ns)
    if not len(steps):
        return []
    wide = np.flatnonzero(steps > periods * np.median(steps))
    return [(int(stamps_ns[i]), int(stamps_ns[i + 1])) for i in wide]


def _far_from(stamps_ns: Int, own_ns: Int, periods: float) -> Bool:
    """Return which stamps (N,) are more than ``periods`` median periods from all of a pair's own (M,), increasing."""
    if len(own_ns) < 2:
        return ~np.isin(stamps_ns, own_ns)
    after = np.clip(np.searchsorted(own_ns, stamps_ns), 1, len(own_ns) - 1)
    nearest = np.minimum(np.abs(stamps_ns - own_ns[after - 1]), np.abs(own_ns[after] - stamps_ns))
    return np.asarray(nearest > periods * np.median(np.diff(own_ns)))


def _ms(duration_ns: int) -> str:
    return f"{1e-6 * duration_ns:.0f} ms"
