"""What the pictures of reports have in common; only matplotlib's objects are used, and pyplot is left alone."""

from __future__ import annotations

from io import BytesIO
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

DPI = 110
BLUE, RED, GREEN, GREY = "#1f5fbf", "#d62728", "#2ca02c", "#777777"
GRID: dict[str, Any] = {"color": "#e2e2e2", "linewidth": 0.6}


def empty_figure(width_in: float, height_in: float) -> Figure:
    """A white figure without axes."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def add_axes(figure: Figure, place: tuple[float, float, float, float]) -> Any:
    """Axes with a grid behind the data; left, bottom, width and height in shares of the figure."""
    axes = figure.add_axes(place)
    axes.grid(**GRID)
    axes.set_axisbelow(True)
    return axes


def single(width_in: float, height_in: float) -> tuple[Figure, Any]:
    """A figure with one pair of axes."""
    figure = empty_figure(width_in, height_in)
    return figure, add_axes(figure, (0.11, 0.16, 0.85, 0.74))


def png(figure: Figure) -> bytes:
    """The figure as a PNG; equal figures give equal bytes."""
    held = BytesIO()
    figure.savefig(held, format="png", metadata={"Software": None})
    return held.getvalue()
