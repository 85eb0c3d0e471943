"""What vision finds that a person would want to know of: failures, frozen cameras, pairs that are not where the rig
says."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from graphvio.frontend.alignment import Misalignment, misplaced
from graphvio.measurements.motion import Quality, VisualResult
from graphvio.rig import Rig


class VisionReports:
    """Tells of each failure, and once of what stays as it is.

    Args:
        rig: whose pairs are named.
        report: is given stamp, kind and detail.
    """

    def __init__(self, rig: Rig, report: Callable[[int, str, str], None]) -> None:
        self._rig = rig
        self._report = report
        self._frozen: frozenset[int] = frozenset()
        self._misaligned: Mapping[int, Misalignment] = {}
        self._told: set[int] = set()

    def update(self, stamp_ns: int, visual: VisualResult, misaligned: Mapping[int, Misalignment]) -> None:
        """Tell what is new with a frameset."""
        if visual.quality is not Quality.GOOD:
            self._report(stamp_ns, f"vision_{visual.quality}", visual.reason)
        for j in sorted(visual.frozen - self._frozen):
            self._report(
                stamp_ns,
                "camera_frozen",
                f"pair {self._rig.pairs[j].name} is left out: a camera repeats its image while others do not",
            )
        self._frozen = visual.frozen
        for j in sorted(misaligned.keys() - self._told):
            self._report(stamp_ns, "extrinsics_off", self._refuted(j, misaligned[j]))
        self._misaligned = dict(misaligned)
        self._told |= misaligned.keys()

    @property
    def rig_warnings(self) -> list[str]:
        """What the motions until now refute of the rig, a sentence each, with its size and one standard deviation."""
        return [self._refuted(j, misalignment) for j, misalignment in sorted(self._misaligned.items())]

    def _refuted(self, j: int, misalignment: Misalignment) -> str:
        return f"{misplaced(self._rig, j, misalignment)}; corrected for this run"
