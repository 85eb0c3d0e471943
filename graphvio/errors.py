"""Typed errors: every message says what is wrong, where, and what to do about it."""


class GraphvioError(Exception):
    """Base of every error that a user's input can cause."""


class RigError(GraphvioError):
    """A rig file, or the rig that it describes, cannot be used."""


class SourceError(GraphvioError):
    """A recording cannot be read, or holds nothing to work on."""


class ConfigError(GraphvioError):
    """A configuration file, profile or value is not valid."""


class MeasurementError(GraphvioError):
    """An IMU sample or frameset that a program hands over is malformed."""


class TrajectoryError(GraphvioError):
    """A trajectory file cannot be read, or two trajectories cannot be compared."""


class MissingExtraError(GraphvioError):
    """An optional part of graphvio is used that is not installed."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs {package}: install it with  pip install 'graphvio[{extra}]'")


class SessionError(GraphvioError):
    """A session's file cannot be read or written."""


class CalibrationError(GraphvioError):
    """Motions from which the cameras' places on the rig cannot be found."""


class OptimizationError(GraphvioError):
    """A session cannot be optimised, or what was kept of it not be read."""


class FleetError(GraphvioError):
    """Sessions cannot be listed, their files not be reached, or the workers not be used."""


class ServiceError(GraphvioError):
    """A service cannot be offered or reached, refuses a client, or was told something malformed."""


class MapError(GraphvioError):
    """A map cannot be read or written, or does not fit the rig; or keyframes cannot be mapped."""
