"""Typed errors, whose messages say what is wrong, where, and what to do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager


class GraphvioError(Exception):
    """Base of every error that a user's input can cause."""


class RigError(GraphvioError):
    """A rig file, or the rig that it describes, cannot be used."""


class SourceError(GraphvioError):
    """A recording cannot be read, or holds nothing to work on."""


class ConfigError(GraphvioError):
    """A configuration file, profile or value is not valid."""


class MeasurementError(GraphvioError):
    """An IMU sample or frameset that a program passes in is malformed."""


class TrajectoryError(GraphvioError):
    """A trajectory file cannot be read, or two trajectories cannot be compared."""


class MissingExtraError(GraphvioError):
    """An optional part of graphvio that is used is not installed."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs {package}: install it with  pip install 'graphvio[{extra}]'")


class MissingRequirementError(GraphvioError):
    """A package that graphvio requires is not installed."""

    def __init__(self, packages: Sequence[str]) -> None:
        names = ", ".join(packages)
        super().__init__(f"needs {names}, which this Python lacks: install with  pip install {' '.join(packages)}")


class SessionError(GraphvioError):
    """A session's file cannot be read or written."""


class CalibrationError(GraphvioError):
    """A calibration cannot be determined from the measurements, or its results cannot be written."""


class OptimizationError(GraphvioError):
    """A session cannot be optimised, or stored results of it cannot be read."""


class FleetError(GraphvioError):
    """Sessions cannot be listed, their files cannot be reached, or the workers cannot be used."""


class ServiceError(GraphvioError):
    """A service cannot be started or reached, refuses a client, or received a malformed message."""


class MapError(GraphvioError):
    """A map cannot be read or written or does not fit the rig, or keyframes cannot be mapped."""


class BenchmarkError(GraphvioError):
    """A data set is not known, or a folder holds none of its sequences."""


def reading(place: object, error: type[GraphvioError], remedy: str) -> AbstractContextManager[None]:
    """Raise a failure of the file system as a typed error.

    Args:
        place: file or folder that is read, for the message.
        error: type to raise.
        remedy: what to do, the end of the message.

    Returns:
        A context whose `OSError` becomes the typed error.
    """
    return _accessing(f"{place}: cannot be read", error, remedy)


def writing(place: object, error: type[GraphvioError], remedy: str) -> AbstractContextManager[None]:
    """Raise a failure of the file system as a typed error, as `reading` does.

    Args:
        place: file or folder that is written to, for the message.
        error: type to raise.
        remedy: what to do, the end of the message.

    Returns:
        A context whose `OSError` becomes the typed error.
    """
    return _accessing(f"{place}: cannot be written", error, remedy)


@contextmanager
def _accessing(what: str, error: type[GraphvioError], remedy: str) -> Iterator[None]:
    try:
        yield
    except OSError as failure:
        raise error(f"{what} ({failure.strerror or failure}); {remedy}") from None


@contextmanager
def importing(package: str, extra: str, purpose: str) -> Iterator[None]:
    """Raise a failing import as an error that says how to install the missing package.

    Args:
        package: package that is imported.
        extra: extra of graphvio that includes the package.
        purpose: what needs the package, the beginning of the message.

    Raises:
        MissingExtraError: if something inside cannot be imported.
    """
    try:
        yield
    except ImportError:
        raise MissingExtraError(package, extra, purpose) from None
