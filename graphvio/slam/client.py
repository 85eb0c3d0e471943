"""The odometry at the other end of a wire, as if it were here; needs the optional part ``serve``."""

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
    """What a server serves.

    Attributes:
        version: of graphvio there.
        run_id: names the run of the odometry.
        epoch: of the newest keyframe, or None before the first.
        oldest_keyframe_id: that is still kept.
        next_keyframe_id: the newest one's, plus one.
        has_ended: whether no keyframe is to come.
    """

    version: str
    run_id: str
    epoch: int | None
    oldest_keyframe_id: int
    next_keyframe_id: int
    has_ended: bool


@dataclass(frozen=True, slots=True, eq=False)
class Update(Generic[S]):
    """Where the rig is.

    Attributes:
        state: an estimate, without what diagnoses the odometry (innovations, rates, pairs, times), or a prediction.
            Its nav frame is the epoch's odom frame.
        map_T_odom: (4, 4) in force for the state's epoch when it was sent, or None before the first correction.
        missed: how many were left out since the one before, because this client was slow. What came while a connection
            was broken is not counted.
    """

    state: S
    map_T_odom: Float | None
    missed: int


class Client:
    """A `graphvio.slam.interface.SlamFrontEnd` over gRPC; a context manager, usable from several threads.

    Args:
        address: ``HOST:PORT``, or ``HOST`` with the usual port.
        ca: PEM file of the certificates to trust, for a server with TLS; its name must be one that its certificate has.
        token: what the server demands; `read_token` reads it from a file.
        timeout_s: how long an answer may take.
        patience_s: how long iterators try to come back when the connection is broken.

    Raises:
        MissingExtraError: when the module is imported, if grpcio is not installed.
        ServiceError: if the server cannot be reached or refuses. All methods may raise it.
        RigError: if its rig is not usable here.
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
        """Cameras and IMU of the keyframes; masks stay with the cameras."""
        return self._rig

    def info(self) -> ServerInfo:
        """What is served now."""
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
        """How the odometry runs, by name."""
        return convert.status_of(self._call("GetStatus", messages.GetStatusRequest()))

    def keyframes(
        self, from_id: int = 0, *, with_images: bool = False, with_descriptors: bool = True
    ) -> Iterator[Keyframe]:
        """Keyframes as they come, each waited for, until the odometry has ended.

        When the connection breaks, it is made again, and the iterator goes on with the next keyframe.

        Args:
            from_id: where to begin. Ids that are passed over were no longer kept.
            with_images: whether they are wanted, too; about a byte for each pixel.
            with_descriptors: whether landmarks are to have them.

        Raises:
            ServiceError: also if another run of the odometry is served meanwhile; its ids mean something else.
        """
        next_id = from_id

        def request() -> Any:
            return messages.StreamKeyframesRequest(
                from_id=next_id, with_images=with_images, with_descriptors=with_descriptors, run_id=self._run_id
            )

        for update in self._connection.follow(self._connection.stub.StreamKeyframes, request):
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
        """Where the rig is, from now on, until the odometry has ended; new ones for whoever is slow.

        Args:
            rate: estimates at each frameset, or predictions at each sample of the IMU.
        """
        return self._estimates() if rate == "frame" else self._predictions()

    def events(self) -> Iterator[Event]:
        """What a person would want to know of, from now on, until the odometry has ended."""
        request = messages.StreamEventsRequest(run_id=self._run_id)
        for update in self._connection.follow(self._connection.stub.StreamEvents, lambda: request):
            yield Event(update.stamp_ns, update.kind, update.detail)

    def correct(self, keyframe_id: int, map_T_body: Float, covariance: Float) -> CorrectionResult:
        """Say where a keyframe is in the map.

        It is not sent again when the connection breaks: whether it has arrived is then not known.

        Args:
            keyframe_id: of it.
            map_T_body: (4, 4) of body there.
            covariance: (6, 6), tangent ``[rotation, translation]`` in body.

        Returns:
            What became of it; a correction that is not believed raises nothing.

        Raises:
            ServiceError: if it is malformed, too, or another run of the odometry is served meanwhile.
        """
        request = messages.CorrectRequest(
            keyframe_id=keyframe_id,
            map_T_body=packed(np.asarray(map_T_body)),
            covariance=packed(np.asarray(covariance)),
            run_id=self._run_id,
        )
        return convert.result_of(self._call("Correct", request))

    def close(self) -> None:
        """End all iterators and the connection; from any thread, a second time does nothing."""
        self._connection.close()

    def _estimates(self) -> Iterator[Update[Estimate]]:
        for update in self._updates(messages.RATE_FRAME):
            yield Update(convert.estimate_of(update.estimate), _map_T_odom(update), update.missed)

    def _predictions(self) -> Iterator[Update[Prediction]]:
        for update in self._updates(messages.RATE_IMU):
            yield Update(convert.prediction_of(update.prediction), _map_T_odom(update), update.missed)

    def _updates(self, rate: int) -> Iterator[Any]:
        request = messages.StreamEstimatesRequest(rate=rate, run_id=self._run_id)
        return self._connection.follow(self._connection.stub.StreamEstimates, lambda: request)

    def _info(self) -> Any:
        return self._call("GetInfo", messages.GetInfoRequest())

    def _call(self, name: str, request: Any) -> Any:
        return self._connection.call(getattr(self._connection.stub, name), request)


def _map_T_odom(update: Any) -> Float | None:
    return maybe_floats(update.map_T_odom, (4, 4), "map_T_odom")
