"""The pose's covariance in the first seconds of walking by a wrong rig file, before keyframes have been adjusted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphvio import Odometry, load_trajectory, open_source
from graphvio.geometry import se3_inverse, se3_log
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw

ERROR = CalibrationErrorSizes.of_level(3, ["left-right-rotation"])


@pytest.mark.parametrize("seed", [6, 8, 9, 11])
def test_covariance_of_the_first_steps_holds_errors_of_the_calibration(long_room_walk: Path, seed: int) -> None:
    true = open_source(long_room_walk)
    assert true.truth is not None
    truth = load_trajectory(true.truth)
    rig = draw(true.rig, ERROR, seed).written_rig.with_pairs([0])
    odometry, distances, first = Odometry(rig), [], None
    for measurement in open_source(long_room_walk, rig, to_s=3.5):
        estimate = odometry.process(measurement)
        if estimate is None or estimate.nav_T_body is None or estimate.covariance is None:
            continue
        both = estimate.nav_T_body, truth.nav_T_body[np.searchsorted(truth.stamps_ns, estimate.stamp_ns)]
        first = first or both
        estimated, walked = (se3_inverse(since) @ now for since, now in zip(first, both, strict=True))
        error = se3_log(se3_inverse(walked) @ estimated)
        distances.append(float(np.sqrt(error @ np.linalg.solve(estimate.covariance, error))))
    assert max(distances) < 4.0
