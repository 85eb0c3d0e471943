"""Events that the front-end gives rise to: failures, frozen cameras, pairs that are not where the rig has them."""

from __future__ import annotations

from collections.abc import Mapping

from graphvio.frontend.alignment import Misalignment, describe
from graphvio.measurements.events import EventKind, Report
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.rig import Rig


class VisionEvents:
    """Reports each failure of vision, and once each state that lasts.

    Args:
        rig: Rig whose pairs are named.
        report: Receives events.
    """

    def __init__(self, rig: Rig, report: Report) -> None:
        self._rig = rig
        self._report = report
        self._frozen: frozenset[int] = frozenset()
        self._misaligned: Mapping[int, Misalignment] = {}
        self._reported: set[int] = set()

    def update(self, stamp_ns: int, visual: VisualResult, misaligned: Mapping[int, Misalignment]) -> None:
        """Report what is new with a frameset.

        Args:
            stamp_ns: Stamp of the frameset.
            visual: The front-end's result for it.
            misaligned: Pair index -> error of its extrinsics that motions are corrected for.
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
        for j in sorted(misaligned.keys() - self._reported):
            self._report(stamp_ns, EventKind.EXTRINSICS_OFF, self._warning(j, misaligned[j]))
        self._misaligned = dict(misaligned)
        self._reported |= misaligned.keys()

    @property
    def rig_warnings(self) -> list[str]:
        """Where the motions contradict the rig: a sentence each, with the size and one standard deviation."""
        return [self._warning(j, misalignment) for j, misalignment in sorted(self._misaligned.items())]

    def _warning(self, j: int, misalignment: Misalignment) -> str:
        return f"{describe(self._rig, j, misalignment)}; corrected for this run"
