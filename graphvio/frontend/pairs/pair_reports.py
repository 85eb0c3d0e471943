"""Reports of what each pair contributed to a frameset, for monitoring a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from graphvio.arrays import Bool
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.motion.observations import Correspondences
from graphvio.frontend.pairs.agreement import Agreement
from graphvio.measurements.motion import PairReport


def inliers_of(pair: int, correspondences: Correspondences, agreement: Agreement) -> Bool:
    """Return which of a pair's points (M,) are inliers of its own motion.

    Where there is no own motion, and for a single camera, they are the inliers of the rig's motion.
    """
    if pair in agreement.own and pair not in correspondences.singles:
        return agreement.own[pair].inlier
    return np.asarray(agreement.hypotheses[0].refined.inlier[correspondences.observations.pair == pair])


def pair_reports(
    frames: Mapping[int, TrackedFrame],
    correspondences: Correspondences,
    agreement: Agreement | None,
    replenished: Mapping[int, TrackedFrame],
) -> dict[int, PairReport]:
    """Return a report of each pair.

    Args:
        frames: Pair index -> its tracks.
        correspondences: Points that both these tracks and the references have.
        agreement: Motions of the pairs, or None without a motion.
        replenished: Pair index -> tracks with new corners, and with the number of those that were rejected; empty if no
            corners were searched for.
    """
    reports = {j: _report(frame, correspondences, j, agreement) for j, frame in frames.items()}
    return {
        j: replace(report, rejected=replenished[j].rejected) if j in replenished else report
        for j, report in reports.items()
    }


def _report(
    frame: TrackedFrame, correspondences: Correspondences, pair: int, agreement: Agreement | None
) -> PairReport:
    is_inlier = np.zeros(len(frame.ids), dtype=bool)
    report = PairReport(0, 0, frame.pixels, is_inlier, frame.ages, frame.rejected)
    if pair not in correspondences.rows:
        return report
    rows = correspondences.rows[pair]
    report = replace(report, points=len(rows))
    if agreement is None:
        return report
    of_pair, chosen = correspondences.observations.pair == pair, agreement.hypotheses[0].refined
    is_inlier[rows] = chosen.inlier[of_pair]
    own = agreement.own.get(pair)
    return replace(
        report,
        inliers=int(is_inlier.sum()),
        is_inlier=is_inlier,
        rms_px=chosen.rms_px(of_pair),
        own_inliers=None if own is None else int(own.inlier.sum()),
        own_rms_px=None if own is None else own.rms_px(),
    )
