"""Display of a live run: a panel in a terminal, or a line every few seconds where there is none."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from graphvio.cli.shared import TerminalDisplay
from graphvio.measurements.events import Event
from graphvio.queues import BoundedQueue

if TYPE_CHECKING:
    from graphvio.measurements.readings import DeviceHealth

Figures = Mapping[str, float | int | str | None]

_REFRESH_S, _PLAIN_S = 0.25, 5.0
_MESSAGES = 6
_COLOURS = {"tracking": "green", "coasting": "yellow", "initialising": "cyan", "lost": "red"}


class Dashboard(TerminalDisplay):
    """Shows the figures, devices and events of a live run; a context manager.

    Args:
        title: title of the panel.
        events: queue from which the events to show are taken.
    """

    def __init__(self, title: str, events: BoundedQueue[Event]) -> None:
        super().__init__()
        self._title = title
        self._events = events
        self._messages: list[str] = []
        self._shown: dict[str, tuple[float, int]] = {}  # kind -> time when last shown, and count since then

    def show(self, figures: Figures, devices: Sequence[DeviceHealth]) -> None:
        """Show the newest figures and events; the figures at most at the refresh rate."""
        now = time.monotonic()
        while (event := self._events.get(0.0)) is not None:
            self._show_event(event, now)
        if now < self._next_s:
            return
        if self._console.is_terminal:
            self._next_s = now + _REFRESH_S
            self._live.update(self._panel(figures, devices), refresh=True)
        else:
            self._next_s = now + _PLAIN_S
            self._print(line_of(figures))

    def _show_event(self, event: Event, now: float) -> None:
        """Show an event; of each kind (and device) at most one every few seconds, with the number of those left out."""
        kind = event.detail if event.kind.startswith("device_") else event.kind
        last, left_out = self._shown.get(kind, (-_PLAIN_S, 0))
        if now - last < _PLAIN_S:
            self._shown[kind] = last, left_out + 1
            return
        self._shown[kind] = now, 0
        more = f" (and {left_out} more before)" if left_out else ""
        self._messages = [*self._messages, f"{event.kind}: {event.detail}{more}"][-_MESSAGES:]
        if not self._console.is_terminal:
            self._print(self._messages[-1])

    def _panel(self, figures: Figures, devices: Sequence[DeviceHealth]) -> Table:
        table = Table(title=self._title, show_header=False, expand=False)
        table.add_column(style="bold")
        table.add_column()
        status = str(figures.get("status", "waiting"))
        table.add_row("status", Text(f"{status}, epoch {figures.get('epoch', 0)}", _COLOURS.get(status, "white")))
        for name, value in rows_of(figures):
            table.add_row(name, value)
        for device in devices:
            state = "connected" if device.connected else "lost"
            lost = "".join(f", {kind} {count}" for kind, count in sorted(device.counts.items()))
            table.add_row(device.name, f"{state}  {device.detail}{lost}")
        for message in self._messages:
            table.add_row("", Text(message, "yellow", no_wrap=True, overflow="ellipsis"))
        return table


def rows_of(figures: Figures) -> list[tuple[str, str]]:
    """Return the name and the text of each row, except for the row of the status."""
    pairs = sorted(name.removesuffix("_points") for name in figures if name.endswith("_points"))
    rows = [
        (
            "rate",
            f"{_number(figures, 'estimate_hz', '.1f')} of {_number(figures, 'frameset_hz', '.1f')} framesets/s, "
            f"IMU {_number(figures, 'imu_hz', '.0f')} Hz",
        ),
        (
            "latency",
            f"p50 {_number(figures, 'latency_p50_ms', '.1f')} ms, p99 {_number(figures, 'latency_p99_ms', '.1f')} ms, "
            f"longest {_number(figures, 'latency_max_ms', '.0f')} ms",
        ),
        (
            "given up",
            f"{_number(figures, 'skipped_late', 'd')} framesets late, {_number(figures, 'skipped_no_room', 'd')} "
            f"without room; corners {100 * float(figures.get('corner_share') or 1.0):.0f} %",
        ),
        ("points", "  ".join(f"{figures[f'{pair}_inliers']}/{figures[f'{pair}_points']}" for pair in pairs) or "-"),
        (
            "bias",
            f"gyro {_number(figures, 'gyro_bias_rad_s', '.4f')} rad/s, "
            f"accelerometer {_number(figures, 'accel_bias_m_s2', '.3f')} m/s^2",
        ),
        ("memory", f"{_number(figures, 'memory_mb', '.0f')} MB"),
    ]
    if figures.get("temperature_c") is not None:
        rows.append(("temperature", f"{_number(figures, 'temperature_c', '.1f')} C"))
    if "recorded_framesets" in figures:
        stopped = figures.get("recording_stopped")
        free = _number(figures, "disk_free_gb", ".1f")
        going_on = f"{_number(figures, 'recorded_framesets', 'd')} framesets, {free} GB free"
        rows.append(("recording", str(stopped) if stopped else going_on))
    if figures.get("stuck"):
        rows.append(("stuck", str(figures["stuck"])))
    return rows


def line_of(figures: Figures) -> str:
    """Return all figures in one line."""
    return f"{figures.get('status', 'waiting'):<12} " + "  ".join(f"{name} {value}" for name, value in rows_of(figures))


def summary_of(figures: Figures) -> str:
    """Return one line with the number of estimates, the latency, and the counts of lost or skipped measurements."""
    kinds = ("skipped", "images_not", "results_not", "imu_lost")
    lost = "".join(f", {name} {count}" for name, count in figures.items() if name.startswith(kinds))
    return (
        f"{figures.get('estimates', 0)} estimates of {figures.get('framesets', 0)} framesets, "
        f"latency p99 {_number(figures, 'latency_p99_all_ms', '.1f')} ms{lost}"
    )


def _number(figures: Figures, name: str, form: str) -> str:
    value: Any = figures.get(name)
    return "-" if value is None else format(value, form)
