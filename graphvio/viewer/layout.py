"""Layout and colours of rerun's window."""

from __future__ import annotations

from typing import Any

import rerun.blueprint as rrb

from graphvio.measurements.estimate import Status
from graphvio.rig import Rig
from graphvio.self_calibration.curves import curves_of

TIMELINE = "time"
AXES = ("x", "y", "z")
RATE_COLOURS = {"gyro": (230, 150, 40), "vision": (60, 150, 230), "fused": (40, 190, 90)}
STATUS_COLOURS = {
    Status.INITIALISING: (23, 163, 152),
    Status.TRACKING: (70, 130, 230),
    Status.COASTING: (242, 142, 28),
    Status.LOST: (214, 39, 40),
}


def as_entity(name: str) -> str:
    """Convert a name to a part of an entity's path: characters that are not alphanumeric become ``_``."""
    return "".join(c if c.isalnum() else "_" for c in name)


def blueprint(rig: Rig) -> Any:
    """Return rerun's layout: the world on the left; left cameras, curves and events on the right."""
    cameras = [
        rrb.Spatial2DView(origin=f"world/rig/{group.left.name}", name=f"{group.name}: {group.left.name}")
        for group in rig.groups
    ]
    rates = rrb.Vertical(
        *(rrb.TimeSeriesView(origin=f"rates/{axis}", name=f"rate {axis}, rad/s") for axis in AXES),
        name="rates",
    )
    biases = rrb.Vertical(
        rrb.TimeSeriesView(origin="biases/gyro", name="gyro bias, rad/s"),
        rrb.TimeSeriesView(origin="biases/accel", name="accelerometer bias, m/s^2"),
        name="biases",
    )
    units = {curve.group: curve.unit for curve in curves_of(rig)}
    calibration = rrb.Grid(
        *(
            rrb.TimeSeriesView(origin=f"calibration/{as_entity(group)}", name=f"{group}, {unit}".rstrip(", "))
            for group, unit in units.items()
        ),
        name="calibration",
    )
    curves = rrb.Tabs(
        rates,
        biases,
        calibration,
        rrb.TimeSeriesView(origin="timing", name="milliseconds"),
        rrb.TimeSeriesView(origin="points", name="points"),
        rrb.TimeSeriesView(origin="residuals", name="residuals, px"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="world", name="world"),
            rrb.Vertical(
                rrb.Grid(*cameras, name="cameras"),
                curves,
                rrb.TextLogView(origin="events", name="events"),
                row_shares=[3.0, 4.0, 1.5],
            ),
            column_shares=[3.0, 2.0],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
