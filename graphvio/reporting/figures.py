"""Figures of reports: style, axes and PNG; uses only matplotlib's objects, not the global state of pyplot."""

from __future__ import annotations

from io import BytesIO
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

DPI = 110
BLUE, RED, GREEN, GREY = "#1f5fbf", "#d62728", "#2ca02c", "#777777"
GRID: dict[str, Any] = {"color": "#e2e2e2", "linewidth": 0.6}


def empty_figure(width_in: float, height_in: float, dpi: int = DPI) -> Figure:
    """Create a white figure without axes."""
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def add_axes(figure: Figure, place: tuple[float, float, float, float]) -> Any:
    """Add axes with a grid behind the data; ``place`` is left, bottom, width, height as fractions of the figure."""
    axes = figure.add_axes(place)
    axes.grid(**GRID)
    axes.set_axisbelow(True)
    return axes


def single(width_in: float, height_in: float) -> tuple[Figure, Any]:
    """Create a figure with one axes object."""
    figure = empty_figure(width_in, height_in)
    return figure, add_axes(figure, (0.11, 0.16, 0.85, 0.74))


def png(figure: Figure) -> bytes:
    """Render a figure as PNG; equal figures give equal bytes."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
