"""Client of an odometry that another process serves over gRPC; needs the extra ``serve``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, Self, TypeVar, overload

import numpy as np

from graphvio.arrays import Float
from graphvio.measurements.estimate import Estimate, Prediction
from graphvio.measurements.events import Event
from graphvio.rig import Rig
from graphvio.slam.keyframe import CorrectionResult, Keyframe
from graphvio.slam.service import convert, messages
from graphvio.slam.service.arrays import maybe_floats, packed
from graphvio.slam.service.connection import Connection
from graphvio.slam.service.security import read_token

__all__ = ["Client", "ServerInfo", "Update", "read_token"]

S = TypeVar("S", Estimate, Prediction)


@dataclass(frozen=True)
class ServerInfo:
    """State of the odometry that a server serves."""

    version: str  # version of graphvio on the server
    run_id: str  # unique name of the odometry's run
    epoch: int | None  # epoch of the newest keyframe, or None before the first
    oldest_keyframe_id: int  # id of the oldest keyframe that is still kept
    next_keyframe_id: int  # id of the newest keyframe, plus one
    has_ended: bool  # whether the odometry has ended: no keyframe will follow


@dataclass(frozen=True, slots=True, eq=False)
class Update(Generic[S]):
    """A state of the rig, as the server sent it.

    Attributes:
        state: An estimate, without the odometry's diagnostics (innovations, rates, pairs, times), or a prediction.
            Its nav frame is the epoch's odom frame.
        map_T_odom: (4, 4) correction in force for the state's epoch when it was sent, or None before the first one.
        missed: Number of updates dropped since the previous one because this client was too slow. Updates that were
            lost while a connection was broken are not counted.
    """

    state: S
    map_T_odom: Float | None
    missed: int


class Client:
    """Implementation of `graphvio.slam.interface.SlamFrontEnd` over gRPC; a context manager, thread-safe.

    Args:
        address: ``HOST:PORT``, or ``HOST`` with the default port.
        ca: PEM file of the trusted certificates, for a server with TLS; its host name must be in its certificate.
        token: The server's token; `read_token` reads it from a file.
        timeout_s: Timeout of a call.
        patience_s: How long iterators try to reconnect after the connection is lost.

    Raises:
        MissingExtraError: On import of the module, if grpcio is not installed.
        ServiceError: If the server cannot be reached or refuses. All methods may raise it.
        RigError: If this version cannot read the server's rig.
    """

    def __init__(
        self,
        address: str,
        ca: str | Path | None = None,
        token: str | None = None,
        *,
        timeout_s: float = 10.0,
        patience_s: float = 60.0,
    ) -> None:
        self._connection = Connection(address, ca, token, timeout_s, patience_s)
        try:
            answer = self._info()
            self._run_id: str = answer.run_id
            self._rig = convert.rig_of(answer.rig_yaml, self._connection.address)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def rig(self) -> Rig:
        """Cameras and IMU of the keyframes, without masks."""
        return self._rig

    def info(self) -> ServerInfo:
        """Return the state of the served odometry."""
        answer = self._info()
        return ServerInfo(
            version=answer.version,
            run_id=answer.run_id,
            epoch=answer.epoch if answer.HasField("epoch") else None,
            oldest_keyframe_id=answer.oldest_keyframe_id,
            next_keyframe_id=answer.next_keyframe_id,
            has_ended=answer.has_ended,
        )

    def status(self) -> dict[str, convert.Value]:
        """Return the figures of the odometry's run by name."""
        return convert.status_of(self._connection.call("GetStatus", messages.GetStatusRequest()))

    def keyframes(
        self, from_id: int = 0, *, with_images: bool = False, with_descriptors: bool = True
    ) -> Iterator[Keyframe]:
        """Yield keyframes as they come until the odometry has ended.

        After a lost connection, the client reconnects and continues with the next keyframe.

        Args:
            from_id: Id of the first keyframe. Ids that are skipped were no longer kept.
            with_images: Request the images, about one byte a pixel.
            with_descriptors: Request the landmarks' descriptors.

        Raises:
            ServiceError: Also if the server meanwhile serves another run, whose ids have no relation to these.
        """
        next_id = from_id

        def request() -> Any:
            return messages.StreamKeyframesRequest(
                from_id=next_id, with_images=with_images, with_descriptors=with_descriptors, run_id=self._run_id
            )

        for update in self._connection.follow("StreamKeyframes", request):
            keyframe = convert.keyframe_of(update.keyframe)
            next_id = keyframe.id + 1
            yield keyframe

    @overload
    def estimates(self, rate: Literal["frame"] = "frame") -> Iterator[Update[Estimate]]: ...

    @overload
    def estimates(self, rate: Literal["imu"]) -> Iterator[Update[Prediction]]: ...

    def estimates(
        self, rate: Literal["frame", "imu"] = "frame"
    ) -> Iterator[Update[Estimate]] | Iterator[Update[Prediction]]:
        """Yield states from now on until the odometry has ended; a slow reader gets the newest ones.

        Args:
            rate: ``frame`` for an estimate at each frameset, ``imu`` for a prediction at each sample of the IMU.
        """
        return self._updates(messages.RATE_FRAME if rate == "frame" else messages.RATE_IMU)

    def events(self) -> Iterator[Event]:
        """Yield the odometry's events from now on until it has ended."""
        request = messages.StreamEventsRequest(run_id=self._run_id)
        for update in self._connection.follow("StreamEvents", lambda: request):
            yield Event(update.stamp_ns, update.kind, update.detail)

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """Correct the pose of a keyframe in the map, see `SlamFrontEnd.correct`.

        The call is not repeated after a lost connection: whether the correction arrived is then unknown.

        Args:
            keyframe_id: Id of the keyframe.
            map_T_body: (4, 4) pose of body in the map.
            covariance: (6, 6) covariance of that pose, tangent ``[rotation, translation]`` in body.

        Returns:
            Whether the correction was accepted, and if not, why.

        Raises:
            ServiceError: Also if the correction is malformed, or the server meanwhile serves another run.
        """
        request = messages.CorrectRequest(
            keyframe_id=keyframe_id,
            map_T_body=packed(np.asarray(map_T_body)),
            covariance=packed(np.asarray(covariance)),
            run_id=self._run_id,
        )
        return convert.result_of(self._connection.call("Correct", request))

    def close(self) -> None:
        """End all iterators and close the connection; thread-safe, and idempotent."""
        self._connection.close()

    def _updates(self, rate: int) -> Iterator[Update[Any]]:
        request = messages.StreamEstimatesRequest(rate=rate, run_id=self._run_id)
        for update in self._connection.follow("StreamEstimates", lambda: request):
            if rate == messages.RATE_FRAME:
                state: Any = convert.estimate_of(update.estimate)
            else:
                state = convert.prediction_of(update.prediction)
            yield Update(state, maybe_floats(update.map_T_odom, (4, 4), "map_T_odom"), update.missed)

    def _info(self) -> Any:
        return self._connection.call("GetInfo", messages.GetInfoRequest())
