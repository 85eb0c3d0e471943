"""Something that is drawn over on a terminal, and told line by line elsewhere."""

from __future__ import annotations

from typing import Self


class Redrawn:
    """A context manager around the drawing, on stderr; what is drawn is gone at its end."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._console = Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._next_s = 0.0

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()
