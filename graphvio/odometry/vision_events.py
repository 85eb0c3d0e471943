"""Events that the front-end gives rise to: failures, frozen cameras, pairs that are not where the rig has them."""

from __future__ import annotations

from collections.abc import Mapping

from graphvio.frontend.extrinsic_monitor import ExtrinsicError, describe
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
        self._extrinsic_errors: Mapping[int, ExtrinsicError] = {}
        self._reported: set[int] = set()

    def update(self, stamp_ns: int, visual: VisualResult, extrinsic_errors: Mapping[int, ExtrinsicError]) -> None:
        """Report what is new with a frameset.

        Args:
            stamp_ns: Stamp of the frameset.
            visual: The front-end's result for it.
            extrinsic_errors: Pair index -> error of its extrinsics that motions are corrected for.
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

    @property
    def rig_warnings(self) -> list[str]:
        """Where the motions contradict the rig: a sentence each, with the size and one standard deviation."""
        return [self._warning(j, error) for j, error in sorted(self._extrinsic_errors.items())]

    def _warning(self, j: int, error: ExtrinsicError) -> str:
        return f"{describe(self._rig, j, error)}; corrected for this run"
