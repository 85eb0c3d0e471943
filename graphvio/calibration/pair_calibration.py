"""P_12 of two pairs from what each tells of its own motion, by both methods (section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from graphvio.arrays import Bool, Float, Int
from graphvio.calibration import graph, paper_method, scale
from graphvio.calibration.comparison import Comparison, compare
from graphvio.calibration.consistency import LIMIT, Further, squared_distances, whitened
from graphvio.calibration.dispersion import dispersion
from graphvio.calibration.graph import GraphSolution
from graphvio.calibration.intervals import Segments, most_telling, of_one_length, worth
from graphvio.calibration.observability import Observability
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.calibration.scale import ScaleCheck, ScaleMode
from graphvio.calibration.validation import Grown, Halves, alignment_lengths, growth, halves, resampled
from graphvio.geometry import se3_adjoint, se3_inverse, se3_log

SEEN_FROM = np.diag(np.repeat([4e-5, 1.5e-4], 3) ** 2)
"""How well images tell the place of the camera that they are from, covariance (6, 6): a fiftieth of a pixel, and what
that is at the distance of a wall. All motions of a camera share this error, so no recording makes it smaller."""

_MOST_OUTLIERS = 0.5
_SCALE_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class PairCalibration:
    """Where the second of two pairs is, and how that was found.

    Attributes:
        solution: the graph's, with what the motions tell.
        pairs: N pose pairs that it was found from.
        frames: M pose pairs from each instant to the next, as the paper's.
        paper_left2_T_left1: (4, 4) by the paper's method.
        comparison: of both methods.
        dispersion: by how much the solution's covariance exceeds what the motions' covariances make of it.
        scale: whether both measure the same lengths.
        scale_estimated: whether lengths of the second were put right by it.
        further: unknowns besides, or None.
        floor: (6, 6) what no recording tells, however long, which is in `covariance`.
        seed: of the random triples, and of the bootstrap.
    """

    solution: GraphSolution
    pairs: PosePairs
    frames: PosePairs
    paper_left2_T_left1: Float
    comparison: Comparison
    dispersion: float
    scale: ScaleCheck
    scale_estimated: bool
    further: Further | None
    floor: Float
    seed: int

    @property
    def left2_T_left1(self) -> Float:
        """(4, 4), the paper's P_12, by the graph."""
        return self.solution.left2_T_left1

    @property
    def covariance(self) -> Float:
        """(6, 6) of it, tangent ``[rotation, translation]`` in left1; very large where the motions do not tell."""
        return self.dispersion * self.solution.covariance + self.floor

    @property
    def inlier(self) -> Bool:
        """(N,) pose pairs that are no outliers."""
        return self.solution.inlier

    @property
    def squares(self) -> Float:
        """(N,) squared Mahalanobis distances of their errors, 6 degrees of freedom each."""
        return self.solution.squares

    @property
    def observability(self) -> Observability:
        """What the motions tell."""
        return self.solution.observability

    @cached_property
    def halves(self) -> Halves | None:
        """First half of the recording against the second; None where one does not tell enough."""
        return halves(self.pairs, self.solution, self.dispersion, self.further, self.floor)

    @cached_property
    def resampled_covariance(self) -> Float:
        """(6, 6) of the solution by a bootstrap."""
        return self._resampled[:6, :6]

    @cached_property
    def further_sigmas(self) -> Float:
        """(M,) of the further unknowns: as the graph has them or as the bootstrap does, whichever is larger."""
        told = self.dispersion * np.diag(self.solution.further_covariance)
        return np.sqrt(np.maximum(told, np.diag(self._resampled)[6:]))

    @cached_property
    def _resampled(self) -> Float:
        return resampled(self.pairs, self.solution, self.further, self.seed)

    @cached_property
    def growth(self) -> tuple[Grown, ...]:
        """Solutions from longer and longer beginnings of the recording, with `covariance`'s allowances."""
        return tuple(
            each._replace(covariance=self.dispersion * each.covariance + self.floor)
            for each in growth(self.pairs, self.solution, self.further)
        )

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for everything that a person should know before using the result; none if all is well."""
        told = list(self.observability.missing)
        if self.scale.is_wrong and not self.scale_estimated:
            return tuple(told)  # which makes all of the following fail
        if not self.comparison.agrees:
            told.append(_disagreement(self.comparison))
        share = 1.0 - float(self.inlier.mean())
        if share > _MOST_OUTLIERS:
            told.append(f"{100 * share:.0f} % of the motions do not fit: look at each pair's own trajectory")
        if self.halves is not None and not self.halves.agree:
            told.append(
                f"the recording's halves differ by {size_in_words(self.halves.difference)}, more than their noise "
                f"explains (chi-square {self.halves.statistic:.0f} of 6): was a camera moved?"
            )
        return tuple(told)

    @cached_property
    def alignment_errors_m(self) -> Float:
        """(N,) lengths of the paper's alignment errors, eq. (7)."""
        return alignment_lengths(self.pairs, self.left2_T_left1)

    @cached_property
    def frame_errors_m(self) -> Float:
        """(M,) the same from each instant to the next."""
        return alignment_lengths(self.frames, self.left2_T_left1)

    @cached_property
    def frame_inlier(self) -> Bool:
        """(M,) which of these are no outliers."""
        return np.asarray(squared_distances(self.frames, self.left2_T_left1) <= LIMIT)

    def apart(self, left2_T_left1: Float) -> Float:
        """(6,) tangent from the solution to another ``left2_T_left1`` (4, 4), such as a rig file's."""
        return se3_log(se3_inverse(self.left2_T_left1) @ np.ascontiguousarray(left2_T_left1))

    def distance(self, left2_T_left1: Float) -> float:
        """Squared Mahalanobis distance (6 degrees of freedom) of another ``left2_T_left1`` (4, 4)."""
        apart = self.apart(left2_T_left1)
        return float(apart @ np.linalg.solve(self.covariance, apart))


def calibrate_pair(
    segments: Segments,
    seed: int = 0,
    *,
    further: Further | None = None,
    scale_mode: ScaleMode = "auto",
    seen_from: Float = SEEN_FROM,
) -> PairCalibration:
    """Calibrate two pairs.

    Args:
        segments: of two cameras, all that may be chosen from.
        seed: of the random triples, and of the bootstrap.
        further: unknowns besides, with derivatives for all segments.
        scale_mode: whether the second camera's lengths may be wrong by a factor, an unknown then: ``fixed``,
            ``estimate``, or ``auto`` where they are beyond doubt.
        seen_from: covariance (6, 6) of where each camera is, as its images have it.

    Raises:
        CalibrationError: if there are fewer than three pose pairs, the rig hardly turned, or no relative pose explains
            the motions; the message says what to do.
    """
    rows = np.array(of_one_length(segments), dtype=np.int64)
    first = segments.pairs.chosen(rows)
    begun = graph.solve(first, paper_method.calibrate(first, seed).left2_T_left1, _of(further, rows))
    worths = worth(segments.pairs, begun.left2_T_left1, begun.covariance)
    rows = np.array(most_telling(segments, worths), dtype=np.int64)
    pairs, further = segments.pairs.chosen(rows), _of(further, rows)
    checked = _scale(pairs, begun.left2_T_left1, further)
    estimate_scale = scale_mode == "estimate" or (scale_mode == "auto" and checked.is_wrong)
    if estimate_scale:
        pairs = scale.rescaled(pairs, checked.log_ratio)
    paper = paper_method.calibrate(pairs, seed)
    with_scale = _with_scale(pairs, further) if estimate_scale else further
    found = graph.solve(pairs, paper.left2_T_left1, with_scale)
    factor = _dispersion(pairs, found, with_scale)
    floor = allowance(found.left2_T_left1, seen_from)
    frames = segments.pairs.chosen(segments.last - segments.first == 1)
    return PairCalibration(
        solution=found,
        pairs=pairs,
        frames=scale.rescaled(frames, checked.log_ratio) if estimate_scale else frames,
        paper_left2_T_left1=paper.left2_T_left1,
        comparison=compare(pairs, paper, found, factor),
        dispersion=factor,
        scale=checked,
        scale_estimated=estimate_scale,
        further=with_scale,
        floor=floor,
        seed=seed,
    )


def _of(further: Further | None, rows: Bool | Int) -> Further | None:
    return None if further is None else further.chosen(rows)


def _with_scale(pairs: PosePairs, further: Further | None) -> Further:
    return Further(scale.derivatives(pairs), np.array([scale.PRIOR_SIGMA])).beside(further)


def _scale(pairs: PosePairs, start: Float, further: Further | None) -> ScaleCheck:
    """The ratio of lengths, an unknown of the graph; several rounds as its effect is linear only for small ones."""
    log_ratio, checked = 0.0, ScaleCheck(0.0, np.inf)
    for _ in range(_SCALE_ROUNDS):
        right = scale.rescaled(pairs, log_ratio)
        unknowns = _with_scale(right, further)
        found = graph.solve(right, start, unknowns)
        log_ratio += float(found.further[-1])
        variance = _dispersion(right, found, unknowns) * found.further_covariance[-1, -1]
        checked = ScaleCheck(log_ratio, float(np.sqrt(variance)))
        if not checked.is_wrong:
            break
    return checked


def _dispersion(pairs: PosePairs, found: GraphSolution, further: Further | None) -> float:
    some = pairs.chosen(found.inlier)
    errors, jacobians = whitened(some, found.left2_T_left1, _of(further, found.inlier), found.further)
    determined = np.eye(jacobians.shape[2])
    if not found.observability.is_complete:
        undetermined = np.zeros((len(found.observability.undetermined), len(determined)))
        undetermined[:, :6] = found.observability.undetermined
        determined = np.linalg.svd(undetermined)[2][len(undetermined) :]
    return dispersion(some, errors, jacobians, determined)


def allowance(left2_T_left1: Float, seen_from: Float) -> Float:
    """What both cameras' own errors, see `SEEN_FROM`, make of the relative pose (6, 6), tangent in left1."""
    adjoint = se3_adjoint(se3_inverse(left2_T_left1))
    return np.asarray(seen_from + adjoint @ seen_from @ adjoint.T)


def _disagreement(comparison: Comparison) -> str:
    return (
        f"the paper's method and the graph differ by {size_in_words(comparison.difference)}, more than their noise "
        f"explains (chi-square {comparison.statistic:.1f}, limit {comparison.limit:.1f})"
    )


def size_in_words(apart: Float) -> str:
    """Angle and length of a tangent (6,)."""
    return f"{np.rad2deg(np.linalg.norm(apart[:3])):.3f} degrees and {1e3 * np.linalg.norm(apart[3:]):.1f} mm"
