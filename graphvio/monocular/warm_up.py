"""Warm-up of the kernels of single cameras: they are compiled or loaded before the first image."""

from __future__ import annotations

import numpy as np

from graphvio.backend.states import level_gravity
from graphvio.linear_algebra import eigen, solve_rows
from graphvio.measurements.sensors import GRAVITY_M_S2
from graphvio.monocular.adjustment import Measurements, adjust, covariance_of
from graphvio.monocular.initialiser import POSE_SIGMAS
from graphvio.monocular.reprojection import Cameras
from graphvio.monocular.states import States
from graphvio.monocular.structure import PRIOR_INFORMATION, Structure, located
from graphvio.monocular.window_prior import first_prior
from graphvio.rig import Rig
from graphvio.self_calibration.imu_model import PARAMETERS
from graphvio.self_calibration.inertial import InertialSamples
from graphvio.self_calibration.parameters import SINGLE
from graphvio.self_calibration.preintegration import preintegrate
from graphvio.self_calibration.prior import file_prior


def warm_up_keyframe_window(rig: Rig) -> None:
    """Call the kernels of the window and of its calibration, with one landmark, so that they are compiled or loaded."""
    second = 1_000_000_000
    stamps = np.arange(-second // 10, second, 5_000_000)
    readings = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY_M_S2], (len(stamps), 1))
    keyframes = np.array([0, second // 10])
    samples = InertialSamples(
        stamps, readings, keyframes, np.array([1e-3, 1e-2]), 50_000_000, np.ones((len(stamps), 2))
    )
    states = States(keyframes, np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, 3)), level_gravity(), np.zeros(6))
    prior = first_prior(states, np.ones(6), np.zeros(6), POSE_SIGMAS)
    cameras = Cameras.of(rig)
    structure = Structure(
        np.eye(4)[None],
        np.array([0, 2]),
        np.array([0, 1]),
        np.zeros(2, dtype=np.int64),
        np.zeros((2, 2)),
        np.zeros((2, 4)),
    )
    places = located(states.poses, states.falls, cameras, np.zeros((1, 3)), structure, 1.0, PRIOR_INFORMATION, True)
    measured = Measurements(cameras, structure, 1.0, samples, np.zeros(0, dtype=np.int64))
    adjust(measured, states, places, prior, max_steps=1, converged=0.0)
    cameras.moved(np.zeros(SINGLE * len(rig.singles)))
    covariance_of(np.eye(6), np.arange(6))
    eigen(np.eye(7))
    preintegrate(*samples[:2], 0, second // 10, np.zeros(PARAMETERS), samples.noise_densities, samples.max_gap_ns)
    file_prior(rig)
    for part in (np.eye(6), np.eye(9)[:6, :6]):  # whole, and a part of a larger matrix
        solve_rows(part, np.zeros((3, 6)))
