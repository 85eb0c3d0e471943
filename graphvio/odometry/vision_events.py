"""Events caused by the front-end's results: failures, frozen cameras, pairs whose extrinsics are wrong."""

from __future__ import annotations

from collections.abc import Mapping

from graphvio.frontend.pairs.extrinsic_monitor import ExtrinsicError, describe
from graphvio.measurements.events import CORRECTED, EventKind, Report
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.rig import Rig, StereoPair

_UNUSED_NS = 5_000_000_000
_MIN_MOTIONS = 40  # good motions after which a pair that took part in none is reported


class VisionEvents:
    """Reports each failure of vision, and lasting conditions once each.

    Args:
        rig: Rig whose pairs are named.
        report: Receives events.
    """

    def __init__(self, rig: Rig, report: Report) -> None:
        self._rig = rig
        self._report = report
        self._frozen: frozenset[int] = frozenset()
        self._extrinsic_errors: Mapping[int, ExtrinsicError] = {}
        self._reported: set[int] = set()
        self._stereo = {j for j, group in enumerate(rig.groups) if isinstance(group, StereoPair)}
        self._used_ns: dict[int, int] = {}  # pair -> stamp of its last motion, or of its first images
        self._motions: dict[int, int] = dict.fromkeys(self._stereo, 0)  # pair -> good motions while it had images
        self._is_used: set[int] = set()
        self._unused: set[int] = set()  # reported

    def update(self, stamp_ns: int, visual: VisualResult, extrinsic_errors: Mapping[int, ExtrinsicError]) -> None:
        """Report failures and new conditions at a frameset.

        Args:
            stamp_ns: Stamp of the frameset.
            visual: The front-end's result for it.
            extrinsic_errors: Pair index -> error of its extrinsics, for which motions are corrected.
        """
        if visual.quality is not Quality.GOOD:
            failed = visual.quality is Quality.FAILED
            self._report(stamp_ns, EventKind.VISION_FAILED if failed else EventKind.VISION_WEAK, visual.reason)
        for j in sorted(visual.frozen - self._frozen):
            self._report(
                stamp_ns,
                EventKind.CAMERA_FROZEN,
                f"{self._rig.groups[j].name} is left out: a camera repeats its image while others do not",
            )
        self._frozen = visual.frozen
        for j in sorted(extrinsic_errors.keys() - self._reported):
            self._report(stamp_ns, EventKind.EXTRINSICS_OFF, self._warning(j, extrinsic_errors[j]))
        self._extrinsic_errors = dict(extrinsic_errors)
        self._reported |= extrinsic_errors.keys()
        if visual.quality is Quality.GOOD:
            self._note_used(stamp_ns, visual)

    def _note_used(self, stamp_ns: int, visual: VisualResult) -> None:
        """Report each pair that has long taken part in no motion, while other cameras have."""
        for j in self._stereo & visual.pairs.keys():
            self._motions[j] += 1
            if visual.pairs[j].inliers > 0:
                self._used_ns[j] = stamp_ns
                self._is_used.add(j)
                self._unused.discard(j)
            elif stamp_ns - self._used_ns.setdefault(j, stamp_ns) > _UNUSED_NS and j not in self._unused:
                self._unused.add(j)
                self._report(
                    stamp_ns,
                    EventKind.PAIR_UNUSED,
                    f"{self._rig.groups[j].name} has taken part in no motion for 5 s, while other cameras have: check "
                    "its images and its calibration",
                )

    @property
    def rig_warnings(self) -> list[str]:
        """Warnings where the motions contradict the rig, a sentence each, with the size and one standard deviation."""
        return [self._warning(j, error) for j, error in sorted(self._extrinsic_errors.items())] + [
            f"{self._rig.groups[j].name}: took part in none of {motions} motions that other cameras saw; check its "
            "images, which camera is left and which right, and its calibration (graphvio rig)"
            for j, motions in self._motions.items()
            if motions >= _MIN_MOTIONS and j not in self._is_used
        ]

    def _warning(self, j: int, error: ExtrinsicError) -> str:
        return f"{describe(self._rig, j, error)}; {CORRECTED}"
