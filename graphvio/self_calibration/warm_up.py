"""Warm-up of the kernels of the self-calibration: they are compiled or loaded before the first window is adjusted."""

from __future__ import annotations

import numpy as np

from graphvio.linear_algebra import cholesky, inverse, solve_lower, solve_rows
from graphvio.measurements.sensors import GRAVITY_M_S2, ImuSample
from graphvio.rig import Rig
from graphvio.self_calibration.adjustment import adjusted
from graphvio.self_calibration.collector import FIRST_WINDOW_SIGMA_PX, WindowCollector
from graphvio.self_calibration.evidence import Evidence
from graphvio.self_calibration.parameters import RigCalibration
from graphvio.self_calibration.prior import file_prior
from graphvio.self_calibration.window import Keyframe, View


def warm_up_adjustment(rig: Rig) -> None:
    """Adjust two keyframes that see one point, to compile or load the kernels."""
    stamps_ns, point = (0, 100_000_000), np.full((1, 2), 100.0)
    seen = View(np.zeros(1, dtype=np.int64), point, point, np.ones(1, dtype=bool), np.ones(1))
    keyframes = tuple(Keyframe(stamp_ns, np.eye(4), {0: seen}) for stamp_ns in stamps_ns)
    collector, of_file = WindowCollector(rig), file_prior(rig)
    for stamp_ns in (-10_000_000, *stamps_ns, 110_000_000) if rig.imu is not None else ():
        collector.add_sample(ImuSample(stamp_ns, np.zeros(3), np.array([0.0, 0.0, GRAVITY_M_S2])))
    prior = Evidence.none(len(of_file.group)).given(of_file, np.ones(of_file.n_groups))
    samples, nominal = collector.samples_of(keyframes), RigCalibration.of(rig)
    adjusted(keyframes, samples, nominal, prior.mean, prior, FIRST_WINDOW_SIGMA_PX)
    information, right = np.eye(2), np.zeros((2, 2))  # for `evidence`, `solver` and `inertial_state`
    solve_lower(cholesky(information), right)
    solve_rows(information, right)
    inverse(information)
