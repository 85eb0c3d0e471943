"""graphvio: visual-inertial odometry for rigs of stereo pairs and single cameras.

The names below are loaded when they are first used, so that ``import graphvio`` stays fast.
"""

import zlib  # noqa: F401 - before pycolmap, see `graphvio.runtime.has_mixed_zlib`
from importlib import import_module
from typing import TYPE_CHECKING

from graphvio.version import __version__

if TYPE_CHECKING:
    from graphvio.calibration.calibrate import calibrate_pairs, calibrate_trajectories
    from graphvio.calibration.result import Calibration
    from graphvio.config import Config
    from graphvio.errors import (
        CalibrationError,
        ConfigError,
        GraphvioError,
        MeasurementError,
        MissingExtraError,
        OptimizationError,
        RigError,
        SourceError,
    )
    from graphvio.measurements.estimate import Estimate, Prediction, Status
    from graphvio.measurements.sensors import FrameSet, ImuSample
    from graphvio.odometry import Odometry
    from graphvio.odometry.recorded_calibration import calibrate_recording
    from graphvio.optimization.optimize import Optimization
    from graphvio.optimization.pipeline import optimize_sessions
    from graphvio.rig import Camera, Imu, Rig, SingleCamera, StereoPair
    from graphvio.rig_files import load_rig, save_rig
    from graphvio.sources import open_source
    from graphvio.trajectory import Trajectory
    from graphvio.trajectory_files import load_trajectory, save_trajectory

_HOME_OF = {
    "Calibration": "calibration.result",
    "CalibrationError": "errors",
    "Camera": "rig",
    "Config": "config",
    "ConfigError": "errors",
    "Estimate": "measurements.estimate",
    "MeasurementError": "errors",
    "FrameSet": "measurements.sensors",
    "GraphvioError": "errors",
    "Imu": "rig",
    "ImuSample": "measurements.sensors",
    "MissingExtraError": "errors",
    "Odometry": "odometry",
    "Optimization": "optimization.optimize",
    "OptimizationError": "errors",
    "Prediction": "measurements.estimate",
    "Rig": "rig",
    "RigError": "errors",
    "SingleCamera": "rig",
    "SourceError": "errors",
    "Status": "measurements.estimate",
    "StereoPair": "rig",
    "Trajectory": "trajectory",
    "calibrate_pairs": "calibration.calibrate",
    "calibrate_recording": "odometry.recorded_calibration",
    "calibrate_trajectories": "calibration.calibrate",
    "load_rig": "rig_files",
    "load_trajectory": "trajectory_files",
    "open_source": "sources",
    "optimize_sessions": "optimization.pipeline",
    "save_rig": "rig_files",
    "save_trajectory": "trajectory_files",
}

__all__ = [
    "Calibration",
    "CalibrationError",
    "Camera",
    "Config",
    "ConfigError",
    "Estimate",
    "FrameSet",
    "GraphvioError",
    "Imu",
    "ImuSample",
    "MeasurementError",
    "MissingExtraError",
    "Odometry",
    "Optimization",
    "OptimizationError",
    "Prediction",
    "Rig",
    "RigError",
    "SingleCamera",
    "SourceError",
    "Status",
    "StereoPair",
    "Trajectory",
    "__version__",
    "calibrate_pairs",
    "calibrate_recording",
    "calibrate_trajectories",
    "load_rig",
    "load_trajectory",
    "open_source",
    "optimize_sessions",
    "save_rig",
    "save_trajectory",
]


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'graphvio' has no attribute {name!r}")
    value = getattr(import_module(f"graphvio.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
