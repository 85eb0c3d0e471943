"""Calibration of two pairs from the motions that each measures, by the paper's method and by a graph (section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.calibration import graph, paper_method
from graphvio.calibration.comparison import Comparison, compare
from graphvio.calibration.consistency import LIMIT, whitened
from graphvio.calibration.graph import GraphSolution
from graphvio.calibration.nuisances import Nuisances, ScaleCheck, ScaleMode, rescaled
from graphvio.calibration.observability import Observability
from graphvio.calibration.pose_pairs import PosePairs
from graphvio.calibration.segments import Segments, information_gains, most_informative, of_one_length
from graphvio.calibration.validation import Grown, Halves, alignment_lengths, dispersion, growth, halves, resampled
from graphvio.geometry import se3_adjoint, se3_inverse, se3_log

SYSTEMATIC_POSE_COVARIANCE = np.diag(np.repeat([4e-5, 1.5e-4], 3) ** 2)
"""Covariance (6, 6) of the systematic error of a camera's pose by its images: a fiftieth of a pixel, and its effect at
the distance of a wall. All motions of a camera share this error, so no recording makes it smaller."""

_MAX_OUTLIERS = 0.5
_SCALE_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class PairCalibration:
    """The relative pose of two pairs, with the data and checks of its estimation."""

    solution: GraphSolution  # solution of the graph
    pairs: PosePairs  # N pose pairs from which it was found
    frames: PosePairs  # M pose pairs from each instant to the next, as in the paper
    paper_left2_T_left1: Float  # (4, 4) by the paper's method
    comparison: Comparison  # comparison of both methods
    dispersion: float  # factor on the solution's covariance, see `validation.dispersion`
    scale: ScaleCheck  # ratio of the lengths that both measure
    scale_estimated: bool  # whether lengths of the second pair were corrected by this ratio
    nuisances: Nuisances  # nuisance variables that were estimated as well
    floor: Float  # (6, 6) covariance of systematic errors, which is part of `covariance`
    seed: int  # seed of the random triples and of the bootstrap

    @property
    def left2_T_left1(self) -> Float:
        """Relative pose (4, 4), the paper's P_12, by the graph."""
        return self.solution.left2_T_left1

    @property
    def covariance(self) -> Float:
        """Covariance (6, 6) of left2_T_left1, tangent ``[rotation, translation]`` in left1."""
        return self.dispersion * self.solution.covariance + self.floor

    @property
    def inlier(self) -> Bool:
        """Mask (N,) of pose pairs that are not outliers."""
        return self.solution.inlier

    @property
    def observability(self) -> Observability:
        """Directions that the motions determine."""
        return self.solution.observability

    @cached_property
    def halves(self) -> Halves | None:
        """Comparison of the recording's two halves; None where one does not determine the pose."""
        return halves(self.pairs, self.solution, self.dispersion, self.nuisances, self.floor)

    @cached_property
    def resampled_covariance(self) -> Float:
        """Covariance (6, 6) of the solution, estimated by a bootstrap."""
        return self._resampled[:6, :6]

    @cached_property
    def nuisance_sigmas(self) -> Float:
        """Standard deviations (M,) of the nuisance variables, the larger of the graph's and the bootstrap's."""
        variances = self.dispersion * np.diag(self.solution.nuisance_covariance)
        return np.sqrt(np.maximum(variances, np.diag(self._resampled)[6:]))

    @cached_property
    def _resampled(self) -> Float:
        return resampled(self.pairs, self.solution, self.nuisances, self.seed)

    @cached_property
    def growth(self) -> tuple[Grown, ...]:
        """Solutions from growing parts of the recording, from its beginning; with dispersion and systematic errors."""
        return tuple(
            each._replace(covariance=self.dispersion * each.covariance + self.floor)
            for each in growth(self.pairs, self.solution, self.nuisances)
        )

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on everything that a user should know before using the result; empty if there is nothing."""
        sentences = list(self.observability.missing)
        if self.scale.is_wrong and not self.scale_estimated:
            return tuple(sentences)  # a wrong scale makes all of the following fail
        if not self.comparison.agrees:
            sentences.append(
                f"the paper's method and the graph differ by {size_in_words(self.comparison.difference)}, more than "
                f"their noise explains (chi-square {self.comparison.statistic:.1f}, limit {self.comparison.limit:.1f})"
            )
        share = 1.0 - float(self.inlier.mean())
        if share > _MAX_OUTLIERS:
            sentences.append(f"{100 * share:.0f} % of the motions do not fit: look at each pair's own trajectory")
        if self.halves is not None and not self.halves.agree:
            sentences.append(
                f"the recording's halves differ by {size_in_words(self.halves.difference)}, more than their noise "
                f"explains (chi-square {self.halves.statistic:.0f} of 6): was a camera moved?"
            )
        return tuple(sentences)

    @cached_property
    def alignment_errors_m(self) -> Float:
        """Lengths (N,) of the paper's alignment errors, eq. (7)."""
        return alignment_lengths(self.pairs, self.left2_T_left1)

    @cached_property
    def frame_errors_m(self) -> Float:
        """Lengths (M,) of the alignment errors from each instant to the next."""
        return alignment_lengths(self.frames, self.left2_T_left1)

    @cached_property
    def frame_inlier(self) -> Bool:
        """Mask (M,) of motions from each instant to the next that are not outliers."""
        errors, _ = whitened(self.frames, self.left2_T_left1)
        return np.asarray(np.sum(errors**2, axis=1) <= LIMIT)

    def apart(self, left2_T_left1: Float) -> Float:
        """Compute the tangent (6,) from the solution to another ``left2_T_left1`` (4, 4), such as a rig file's."""
        return se3_log(se3_inverse(self.left2_T_left1) @ np.ascontiguousarray(left2_T_left1))

    def distance(self, left2_T_left1: Float) -> float:
        """Compute the squared Mahalanobis distance (6 degrees of freedom) of another ``left2_T_left1`` (4, 4)."""
        apart = self.apart(left2_T_left1)
        return float(apart @ np.linalg.solve(self.covariance, apart))


def calibrate_pair(
    segments: Segments,
    seed: int = 0,
    *,
    nuisances: Nuisances | None = None,
    scale_mode: ScaleMode = "auto",
    systematic_pose_covariance: Float = SYSTEMATIC_POSE_COVARIANCE,
) -> PairCalibration:
    """Calibrate two pairs.

    Args:
        segments: all segments of two cameras from which pose pairs may be chosen.
        seed: seed of the random triples and of the bootstrap.
        nuisances: nuisance variables to estimate as well, with derivatives for all segments.
        scale_mode: ``estimate`` the ratio of the second camera's lengths to the first's as a variable, keep it
            ``fixed`` at 1, or ``auto``: estimate it where it differs significantly from 1.
        systematic_pose_covariance: covariance (6, 6) of each camera's pose as its images see it.

    Raises:
        CalibrationError: if there are fewer than three pose pairs, the rig hardly turned, or no relative pose explains
            the motions; the message says what to do.
    """
    nuisances = Nuisances.none(len(segments)) if nuisances is None else nuisances
    rows = of_one_length(segments)
    first = segments.pairs.select(rows)
    initial = graph.solve(first, paper_method.calibrate(first, seed).left2_T_left1, nuisances.select(rows))
    gains = information_gains(segments.pairs, initial.left2_T_left1, initial.covariance)
    rows = most_informative(segments, gains)
    pairs, nuisances = segments.pairs.select(rows), nuisances.select(rows)
    checked = _check_scale(pairs, initial.left2_T_left1, nuisances)
    frames = segments.pairs.select(segments.last - segments.first == 1)
    estimate_scale = scale_mode == "estimate" or (scale_mode == "auto" and checked.is_wrong)
    if estimate_scale:
        pairs, frames = rescaled(pairs, checked.log_ratio), rescaled(frames, checked.log_ratio)
        nuisances = nuisances.with_scale(pairs)
    paper = paper_method.calibrate(pairs, seed)
    found = graph.solve(pairs, paper.left2_T_left1, nuisances)
    factor = _dispersion(pairs, found, nuisances)
    return PairCalibration(
        solution=found,
        pairs=pairs,
        frames=frames,
        paper_left2_T_left1=paper.left2_T_left1,
        comparison=compare(pairs, paper, found, factor),
        dispersion=factor,
        scale=checked,
        scale_estimated=estimate_scale,
        nuisances=nuisances,
        floor=systematic_covariance(found.left2_T_left1, systematic_pose_covariance),
        seed=seed,
    )


def _check_scale(pairs: PosePairs, start: Float, nuisances: Nuisances) -> ScaleCheck:
    """Estimate the ratio of lengths by the graph, in several rounds, as its effect is linear only near 1."""
    log_ratio, checked = 0.0, ScaleCheck(0.0, np.inf)
    for _ in range(_SCALE_ROUNDS):
        corrected = rescaled(pairs, log_ratio)
        with_scale = nuisances.with_scale(corrected)
        found = graph.solve(corrected, start, with_scale)
        log_ratio += float(found.nuisances[-1])
        variance = _dispersion(corrected, found, with_scale) * found.nuisance_covariance[-1, -1]
        checked = ScaleCheck(log_ratio, float(np.sqrt(variance)))
        if not checked.is_wrong:
            break
    return checked


def _dispersion(pairs: PosePairs, found: GraphSolution, nuisances: Nuisances) -> float:
    inliers = pairs.select(found.inlier)
    errors, jacobians = whitened(inliers, found.left2_T_left1, nuisances.select(found.inlier), found.nuisances)
    determined = np.eye(jacobians.shape[2])
    if not found.observability.is_complete:
        undetermined = np.zeros((len(found.observability.undetermined), len(determined)))
        undetermined[:, :6] = found.observability.undetermined
        determined = np.linalg.svd(undetermined)[2][len(undetermined) :]
    return dispersion(inliers, errors, jacobians, determined)


def systematic_covariance(left2_T_left1: Float, systematic_pose_covariance: Float) -> Float:
    """Compute the covariance (6, 6) of the relative pose, tangent in left1, due to both cameras' systematic errors."""
    adjoint = se3_adjoint(se3_inverse(left2_T_left1))
    return np.asarray(systematic_pose_covariance + adjoint @ systematic_pose_covariance @ adjoint.T)


def size_in_words(apart: Float) -> str:
    """Format the angle and length of a tangent (6,)."""
    return f"{np.rad2deg(np.linalg.norm(apart[:3])):.3f} degrees and {1e3 * np.linalg.norm(apart[3:]):.1f} mm"
