"""Progress bar of ``graphvio calibrate`` while it reads a recording, with advice on motions that are still needed."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from graphvio.calibration.camera_motions import SeparateMotions
from graphvio.calibration.guide import Advice, Guide
from graphvio.runtime import on_interrupt


class CalibrationProgress:
    """Context manager with a progress bar while a recording is read; Ctrl-C ends the reading early.

    Args:
        total: number of framesets in the recording.
        guided: names of the pairs, to show advice on their motions; None for no advice.
    """

    _GUIDE_EVERY = 20  # framesets
    _PLAIN_EVERY = 100  # framesets, where there is no terminal

    def __init__(self, total: int, guided: list[str] | None) -> None:
        self.framesets = 0
        self._total = total
        self._console = Console(stderr=True)
        columns = (BarColumn(20), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
        self._bar = Progress(*columns, console=self._console, transient=True)
        self._task = self._bar.add_task("each pair alone", total=total)
        self._guide = None if guided is None else Guide(guided)
        self._was_enough = False
        self._advice: Advice | None = None
        self._interrupted = False

    def __enter__(self) -> CalibrationProgress:
        self._restore = on_interrupt(self._interrupt)
        if self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()
        if self._console.is_terminal:
            self._bar.stop()
        if self._advice is not None and not self._was_enough:
            self._print(f"frameset {self.framesets}: {self._advice.text}")

    def on_frameset(self, number: int, separate: SeparateMotions) -> bool:
        """Show the progress after a frameset, and return whether the reading has to end, after Ctrl-C."""
        self.framesets = number
        self._bar.update(self._task, completed=number)
        if number == self._total:
            self._bar.update(self._task, description="all together")
            self._restore()  # from here on Ctrl-C ends the command
        if self._guide is not None and number % self._GUIDE_EVERY == 0:
            self._show(self._guide.advise(separate.motions()), number)
        return self._interrupted

    def _show(self, advice: Advice, number: int) -> None:
        self._advice = advice
        self._bar.update(self._task, description=advice.text)
        newly_enough = advice.is_enough and not self._was_enough
        self._was_enough = advice.is_enough
        if newly_enough or (not self._console.is_terminal and number % self._PLAIN_EVERY == 0):
            self._print(f"frameset {number}: {advice.text}")

    def _interrupt(self) -> None:
        self._interrupted = True
        self._print(f"ended at frameset {self.framesets} of {self._total}")

    def _print(self, line: str) -> None:
        self._console.print(line, soft_wrap=True, highlight=False)
