"""Parts that several commands share: exit codes, opening a recording, warnings, and progress in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self

import typer

from graphvio.cli.json_output import error_document, publish

if TYPE_CHECKING:
    from rich.progress import Progress

    from graphvio.cli.options import ReadingOptions
    from graphvio.config import Config
    from graphvio.sources import Source
    from graphvio.sources.reading import Reading
    from graphvio.trajectory import Trajectory

EXIT_BAD_INPUT = 2
EXIT_INCOMPLETE = 3  # results are written, but not all that was asked for
EXIT_ABOVE_LIMIT = 4
EXIT_INTERRUPTED = 130
MIN_COMPLETION = 0.9  # share of the framesets that have a pose
_FILES = "a trajectory file (TUM, EuRoC or KITTI), or BAG:TOPIC"


def warn(message: str) -> None:
    """Print a line to stderr, after the program's name."""
    typer.echo(f"graphvio: {message}", err=True)


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return the names of files (without suffix) and folders, or all paths if names repeat."""
    names = [path.name if path.is_dir() else path.stem for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


# ---------------------------------------------------------------------- recordings


def result_trajectory(path: Path, smoothed: bool = False) -> Path:
    """Return the trajectory file in a folder of results; return any other path unchanged.

    Raises:
        TrajectoryError: if the folder holds no results; the message says what is accepted.
    """
    from graphvio.errors import TrajectoryError
    from graphvio.sessions.store import is_store
    from graphvio.sources import is_recording

    if not path.is_dir() or is_store(path):
        return path
    trajectory = "trajectory_smoothed.txt" if smoothed else "trajectory.txt"
    for name in ("trajectory_optimized.txt", trajectory):
        if (path / name).is_file():
            return path / name
    if is_recording(path):
        raise TrajectoryError(
            f"{path}: is a recording, which can only be the truth (the second argument of evaluate, or --truth of "
            f"compare); as a result give a result folder, {_FILES}"
        )
    raise TrajectoryError(f"{path}: holds no {trajectory}; give a result folder, {_FILES}")


def true_trajectory(path: Path, times: Path | None = None) -> Trajectory:
    """Read a trajectory file, or the true trajectory of a recording.

    Raises:
        TrajectoryError: if there is no true trajectory.
        SourceError: if the recording cannot be read.
    """
    from graphvio.errors import TrajectoryError
    from graphvio.sessions.store import is_store
    from graphvio.sources import is_recording, open_source
    from graphvio.trajectory_files import load_trajectory

    if path.is_dir() and not is_store(path):  # a session contains its truth
        if not is_recording(path):
            raise TrajectoryError(f"{path}: is no recording; as the truth give a recording that has one, {_FILES}")
        truth = open_source(path).truth
        if truth is None:
            raise TrajectoryError(
                f"{path}: this recording has no true trajectory; as the truth give a recording that has one, {_FILES}"
            )
        path = truth
    return load_trajectory(path, times)


def open_recording(source: Path, options: ReadingOptions, settings: Config) -> Source:
    """Open a recording with the rig, the cameras, the topics and the interval that a command's options select."""
    from graphvio.rig_files import load_rig

    reading = reading_of(options)
    check_scene(source)
    rig = None if options.rig is None else load_rig(options.rig)
    recording = reading.open(source, rig, settings.timing.simultaneous_ms)
    recording.decodes_in_process = True
    return recording


def reading_of(options: ReadingOptions) -> Reading:
    """Parse a command's options on what is read of a recording.

    Raises:
        RigError: if ``--pairs`` is not a list of numbers.
        SourceError: if ``--topics`` is not a list of NAME=TOPIC.
    """
    from graphvio.errors import RigError, SourceError
    from graphvio.sources.reading import Reading

    try:
        numbers = None if options.pairs is None else tuple(int(each) for each in options.pairs.split(","))
    except ValueError:
        raise RigError(f"--pairs {options.pairs!r}: give numbers separated by commas, such as 0,1") from None
    names = None if options.cameras is None else tuple(name.strip() for name in options.cameras.split(","))
    mapped = [each.split("=") for each in (options.topics or "").split(",") if each]
    if any(len(pair) != 2 or not all(pair) for pair in mapped):
        raise SourceError(
            f"--topics {options.topics}: give NAME=TOPIC separated by commas, such as cam0=/left/image,imu=/imu"
        )
    topic_of = {name.strip(): topic.strip() for name, topic in mapped}
    with_pairs, with_imu = not options.no_pairs, not options.no_imu
    return Reading(numbers, names, with_pairs, with_imu, tuple(topic_of.items()), options.from_s, options.to_s)


def check_scene(source: Path) -> None:
    """Refuse a path that does not exist but names a simulated scene; the error has the command that simulates it."""
    from graphvio.errors import SourceError

    with suppress(OSError):  # opening the recording then reports the error
        if source.exists():
            return
    from graphvio.simulation import SCENE_NAMES  # takes a moment to import

    if str(source) in SCENE_NAMES:
        raise SourceError(
            f"{source}: does not exist; the simulated walk of that name is made by  "
            f"graphvio simulate {source} --out {source}"
        )


def check_session_name(path: Path) -> None:
    """Refuse a session file whose name does not end in .mcap, by which sessions are recognised."""
    from graphvio.errors import SessionError

    if path.suffix != ".mcap":
        raise SessionError(f"{path}: is recorded as MCAP, which is read by its name; name it .mcap")


# ---------------------------------------------------------------------- the terminal


def framesets_bar() -> Progress:
    """Return a progress bar with description, count and remaining time, which disappears at its end."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


@contextmanager
def stage_bars(totals: Mapping[str, int] | None = None) -> Iterator[Callable[[str, float, float], None]]:
    """Show one progress bar for each stage, with description, count and elapsed time; the bars stay visible.

    Yields a function that shows the progress of a stage, by its name, the amount done, and the total. Totals that are
    passed here, stage -> total, take precedence.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    tasks: dict[str, TaskID] = {}
    columns = (TextColumn("{task.description:<28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as bars:

        def show(stage: str, done: float, total: float) -> None:
            total = (totals or {}).get(stage, total)
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield show


@contextmanager
def ends_at_interrupt(message: str) -> Iterator[None]:
    """On Ctrl-C within the block, end the command with a message and the exit code 130."""
    from graphvio.runtime import interruptible

    try:
        with interruptible():
            yield
    except KeyboardInterrupt:
        publish(error_document("Interrupted", message))
        warn(message)
        raise typer.Exit(EXIT_INTERRUPTED) from None


class TerminalDisplay:
    """Base class of displays on stderr: text that is refreshed in place in a terminal, and lines elsewhere.

    It is a context manager.
    """

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

    def _print(self, line: str) -> None:
        self._console.print(line, soft_wrap=True, highlight=False, markup=False)
