"""A report in Markdown: printed as it grows, then written to a file or between two markers of docs/benchmarks.md."""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from graphvio.errors import GraphvioError

DOCS = Path(__file__).resolve().parents[2] / "docs"
_PACKAGES = ("numpy", "numba", "opencv-python-headless", "gtsam")


class Report:
    """Lines of Markdown, printed to stdout as they are added."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add(self, *lines: str) -> None:
        """Add lines; a heading is set off from what follows, and so are the lines from what is added next."""
        spaced = [part for line in lines for part in ((line, "") if line.startswith("#") else (line,))]
        for line in (*spaced, ""):
            print(line)
            self._lines.append(line)
        sys.stdout.flush()

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table; its first column is aligned left, the others right where they hold figures."""
        widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
        figures = [all(_is_figure(row[i]) for row in rows) for i in range(len(head))]

        def line(cells: Sequence[str]) -> str:
            parts = [c.rjust(w) if f else c.ljust(w) for c, w, f in zip(cells, widths, figures, strict=True)]
            return f"| {' | '.join(parts)} |"

        rule = [f"{'-' * (w - 1)}:" if f else "-" * w for w, f in zip(widths, figures, strict=True)]
        self.add(line(head), f"| {' | '.join(rule)} |", *(line(row) for row in rows))

    @property
    def text(self) -> str:
        """The whole text, ending in a newline."""
        return "\n".join(self._lines).rstrip() + "\n"

    def save(self, path: Path) -> None:
        """Write the report to a file, whose folder is made.

        Raises:
            GraphvioError: if it cannot be written.
        """
        with writing(path):
            path.write_text(self.text, encoding="utf-8")

    def write(self, args: argparse.Namespace, name: str) -> None:
        """Write the report where ``--out`` and ``--docs`` say, the latter between the markers of a name."""
        if args.out is not None:
            self.save(args.out)
        if args.docs:
            self.save_to_docs(name)

    def save_to_docs(self, name: str, extra: str = "") -> None:
        """Replace what stands between ``<!-- name -->`` and ``<!-- /name -->`` in docs/benchmarks.md.

        Args:
            name: of the markers.
            extra: Markdown that follows the report, such as the link to a picture.

        Raises:
            GraphvioError: if the page or a marker is missing.
        """
        page = DOCS / "benchmarks.md"
        begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
        try:
            text = page.read_text(encoding="utf-8")
        except OSError as error:
            raise GraphvioError(f"docs/{page.name}: cannot be read ({error.strerror})") from None
        if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
            raise GraphvioError(f"docs/{page.name}: needs one line {begin} and after it one line {end}")
        before, remaining = text.split(begin)
        after = remaining.split(end)[1]
        inside = f"{self.text}\n{extra}\n" if extra else self.text
        page.write_text(f"{before}{begin}\n{inside}{end}{after}", encoding="utf-8")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Make the folder of a file that is written inside; an `OSError` becomes a `GraphvioError`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise GraphvioError(f"{path}: cannot be written ({error.strerror}); choose another place") from None


def log_progress(text: str) -> None:
    """Print one line about progress to stderr."""
    print(text, file=sys.stderr, flush=True)


def machine() -> str:
    """One line: processor, cores, load and versions."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    packages = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    load = f", load {os.getloadavg()[0]:.1f} at the beginning" if hasattr(os, "getloadavg") else ""
    return f"{_processor()}, {cores} cores{load}; Python {platform.python_version()}, {packages}."


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _is_figure(text: str) -> bool:
    return text[:1].isdigit() or text in ("", "-")
