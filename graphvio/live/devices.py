"""Devices that come and go, as one live source: each has a thread that reads it and brings it back when it is lost."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Protocol

from graphvio.errors import SourceError
from graphvio.live.counts import Counts
from graphvio.live.mailbox import Mailbox
from graphvio.measurements.readings import DeviceHealth, Notice, Reading, host_ns
from graphvio.rig import Rig

HandOver = Callable[[Reading], None]

_FIRST_RETRY_S = 0.5
_LONGEST_RETRY_S = 4.0
_JOIN_S = 2.0
_log = logging.getLogger(__name__)


class DeviceLostError(Exception):
    """A device does not deliver any more; the message says what was seen."""


class Device(Protocol):
    """One device, whose methods are called by one thread at a time, but for `detail` and `counts`."""

    @property
    def name(self) -> str:
        """For people, unique in the source."""

    @property
    def clock(self) -> str | None:
        """Name of the clock that stamps its readings."""

    def start(self, hand_over: HandOver) -> None:
        """Find and start it; the driver's threads may hand over from here on.

        Raises:
            SourceError: if it is not there or refuses.
        """

    def run(self, hand_over: HandOver, stopping: threading.Event) -> None:
        """Hand over what comes, or watch those who do, until ``stopping``; any exception says that it is lost."""

    def stop(self) -> None:
        """Let go of it, also where it is half started or gone."""

    def detail(self) -> str:
        """One line: model, firmware, what is wrong."""

    def counts(self) -> Mapping[str, int]:
        """What was lost, by kind."""


class DeviceSource:
    """Devices as a `LiveSource`; see there."""

    is_realtime = True

    def __init__(
        self,
        name: str,
        devices: Sequence[Device],
        rig: Callable[[], Rig],
        retry_s: tuple[float, float] = (_FIRST_RETRY_S, _LONGEST_RETRY_S),
    ) -> None:
        # The rig is asked for when all are started, and may raise RigError; retry_s is the first pause before a lost
        # device is looked for, and the longest.
        self.name = name
        self._devices = tuple(devices)
        self._rig = rig
        self._retry_s = retry_s
        self._mailbox = Mailbox()
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._lost: dict[str, str] = {}
        self._losses = Counts()

    def open(self) -> Rig:
        """See `LiveSource.open`."""
        started: list[Device] = []
        try:
            for device in self._devices:
                started.append(device)
                device.start(self._hand_over(device))
            rig = self._rig()
        except BaseException:
            for device in started:
                _stop(device)
            self.close()
            raise
        for device in self._devices:
            thread = threading.Thread(target=self._attend, args=(device,), name=device.name, daemon=True)
            self._threads.append(thread)
            thread.start()
        return rig

    def readings(self) -> Iterator[Reading]:
        """See `LiveSource.readings`."""
        while (reading := self._mailbox.get()) is not None:
            yield reading

    def health(self) -> Sequence[DeviceHealth]:
        """See `LiveSource.health`."""
        return [self._health(device) for device in self._devices]

    def close(self) -> None:
        """See `LiveSource.close`; a driver that hangs is left to its thread after two seconds."""
        self._stopping.set()
        self._mailbox.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(_JOIN_S)

    def _hand_over(self, device: Device) -> HandOver:
        return partial(self._mailbox.put, device.name)

    def _health(self, device: Device) -> DeviceHealth:
        counts = {**device.counts(), "device_lost": self._losses.totals().get(device.name, 0)}
        counts["not_taken"] = self._mailbox.dropped(device.name)
        lost = self._lost.get(device.name)
        detail = device.detail() if lost is None else f"lost: {lost}"
        connected = lost is None and bool(self._threads) and not self._stopping.is_set()
        return DeviceHealth(device.name, connected, detail, {kind: n for kind, n in counts.items() if n})

    def _attend(self, device: Device) -> None:
        try:
            while not self._stopping.is_set():
                reason = self._reason_of_loss(device)
                if self._stopping.is_set():
                    return
                self._lost[device.name] = reason
                self._losses.add(device.name)
                self._tell(device, "device_lost", reason)
                _stop(device)
                if not self._bring_back(device):
                    return
                del self._lost[device.name]
                self._tell(device, "device_back", "found again; its clock may have begun anew")
        finally:
            _stop(device)

    def _reason_of_loss(self, device: Device) -> str:
        try:
            device.run(self._hand_over(device), self._stopping)
        except DeviceLostError as error:
            return str(error)
        except Exception as error:  # whatever a driver raises, the session goes on
            _log.warning("%s: the driver failed", device.name, exc_info=True)
            return f"{type(error).__name__}: {error}"
        return "it ended by itself"

    def _bring_back(self, device: Device) -> bool:
        pause_s, longest_s = self._retry_s
        while not self._stopping.wait(pause_s):
            pause_s = min(2.0 * pause_s, longest_s)
            try:
                device.start(self._hand_over(device))
            except SourceError as error:
                self._lost[device.name] = str(error)
            except Exception as error:  # as above
                _log.warning("%s: the driver failed", device.name, exc_info=True)
                self._lost[device.name] = f"{type(error).__name__}: {error}"
            else:
                return True
            _stop(device)
        return False

    def _tell(self, device: Device, kind: str, detail: str) -> None:
        notice = Notice(kind, f"{device.name}: {detail}", host_ns(), device.clock)
        self._mailbox.put(device.name, notice)


def _stop(device: Device) -> None:
    with suppress(Exception):  # a device that is gone cannot be stopped in good order
        device.stop()
