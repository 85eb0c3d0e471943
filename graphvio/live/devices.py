"""Several devices as one live source: each has a thread that reads it, and reconnects it after a loss."""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Protocol

from graphvio.errors import SourceError
from graphvio.measurements.events import EventKind
from graphvio.measurements.readings import DeviceHealth, Notice, Reading, host_ns
from graphvio.rig import Rig

HandOver = Callable[[Reading], None]

_MIN_RETRY_S, _MAX_RETRY_S = 0.5, 4.0
_MAX_AGE_NS = 2_000_000_000  # age of waiting readings from which they are dropped: some tens of megabytes of images
_JOIN_S = 2.0
_log = logging.getLogger(__name__)


class DeviceLostError(Exception):
    """Raised when a device does not deliver any more; the message describes the symptom."""


class Counts:
    """Counts by kind; threads of drivers add to them while others read them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, kind: str, count: int = 1) -> None:
        """Add to the count of a kind."""
        if count:
            with self._lock:
                self._counts[kind] += count

    def totals(self) -> dict[str, int]:
        """Return all counts that are not zero."""
        with self._lock:
            return dict(self._counts)


class Mailbox:
    """Queue of several devices' readings for one consumer; readings that wait too long are dropped, except notices."""

    def __init__(self, max_age_ns: int = _MAX_AGE_NS) -> None:
        self._max_age_ns = max_age_ns
        self._changed = threading.Condition()
        self._kept: deque[Notice] = deque()  # notices that are older than all waiting readings
        self._waiting: deque[tuple[str, Reading]] = deque()
        self._is_closed = False
        self._dropped = Counts()

    def put(self, owner: str, reading: Reading) -> None:
        """Add a reading of a device; returns at once, and does nothing after `close`."""
        with self._changed:
            if self._is_closed:
                return
            self._waiting.append((owner, reading))
            while reading.arrival_ns - self._waiting[0][1].arrival_ns > self._max_age_ns:
                its_owner, oldest = self._waiting.popleft()
                if isinstance(oldest, Notice):
                    self._kept.append(oldest)
                else:
                    self._dropped.add(its_owner)
            self._changed.notify()

    def get(self) -> Reading | None:
        """Wait for the oldest reading and take it; None after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._kept or self._waiting or self._is_closed)
            if self._is_closed:
                return None
            return self._kept.popleft() if self._kept else self._waiting.popleft()[1]

    def close(self) -> None:
        """Discard all readings, and accept no more."""
        with self._changed:
            self._is_closed = True
            self._kept.clear()
            self._waiting.clear()
            self._changed.notify_all()

    def dropped(self, owner: str) -> int:
        """Return how many readings of a device were dropped."""
        return self._dropped.totals().get(owner, 0)


class Device(Protocol):
    """Interface of a device; its methods are called by one thread at a time, except for `detail`.

    Attributes:
        counts: number of losses by kind.
    """

    counts: Counts

    @property
    def name(self) -> str:
        """Name for people, unique in the source."""

    @property
    def clock(self) -> str | None:
        """Name of the clock that stamps its readings."""

    def start(self, hand_over: HandOver) -> None:
        """Find and start the device.

        Args:
            hand_over: takes readings; the driver's threads may call it from here on.

        Raises:
            SourceError: if the device is missing or cannot be started.
        """

    def run(self, hand_over: HandOver, stopping: threading.Event) -> None:
        """Hand over readings, or monitor the driver's threads that do so, until the device is stopped or lost.

        Args:
            hand_over: takes readings.
            stopping: set when the device is to be stopped.

        Raises:
            Exception: of any kind, if the device is lost.
        """

    def stop(self) -> None:
        """Release the device, even if it is only partly started or already gone."""

    def detail(self) -> str:
        """Return one line for people: model, firmware, what is wrong."""


class DeviceSource:
    """Devices as a `LiveSource`; see there.

    Args:
        name: name of the source, for people.
        devices: the devices to read.
        rig: returns the rig when all devices are started; may raise RigError.
        retry_s: first and longest pause before a lost device is looked for again.
    """

    is_realtime = True

    def __init__(
        self,
        name: str,
        devices: Sequence[Device],
        rig: Callable[[], Rig],
        retry_s: tuple[float, float] = (_MIN_RETRY_S, _MAX_RETRY_S),
    ) -> None:
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
            thread = threading.Thread(target=self._keep_running, args=(device,), name=device.name, daemon=True)
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
        counts = {**device.counts.totals(), "device_lost": self._losses.totals().get(device.name, 0)}
        counts["not_taken"] = self._mailbox.dropped(device.name)
        lost = self._lost.get(device.name)
        detail = device.detail() if lost is None else f"lost: {lost}"
        connected = lost is None and bool(self._threads) and not self._stopping.is_set()
        return DeviceHealth(device.name, connected, detail, {kind: n for kind, n in counts.items() if n})

    def _keep_running(self, device: Device) -> None:
        try:
            while not self._stopping.is_set():
                reason = self._reason_of_loss(device)
                if self._stopping.is_set():
                    return
                self._lost[device.name] = reason
                self._losses.add(device.name)
                self._notify(device, EventKind.DEVICE_LOST, reason)
                _stop(device)
                if not self._restart(device):
                    return
                del self._lost[device.name]
                self._notify(device, EventKind.DEVICE_BACK, "found again; its clock may have restarted")
        finally:
            _stop(device)

    def _reason_of_loss(self, device: Device) -> str:
        try:
            device.run(self._hand_over(device), self._stopping)
        except DeviceLostError as error:
            return str(error)
        except Exception as error:  # drivers raise any kind of error: the run goes on
            _log.warning("%s: the driver failed", device.name, exc_info=True)
            return f"{type(error).__name__}: {error}"
        return "it ended on its own"

    def _restart(self, device: Device) -> bool:
        pause_s, max_pause_s = self._retry_s
        while not self._stopping.wait(pause_s):
            pause_s = min(2.0 * pause_s, max_pause_s)
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

    def _notify(self, device: Device, kind: str, detail: str) -> None:
        notice = Notice(kind, f"{device.name}: {detail}", host_ns(), device.clock)
        self._mailbox.put(device.name, notice)


def _stop(device: Device) -> None:
    with suppress(Exception):  # a device that is gone cannot be stopped in good order
        device.stop()
