"""Reports in Markdown, printed while they grow, and written to a file or between two markers of a page in docs."""

from __future__ import annotations

import argparse
import os
import platform
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from graphvio.errors import GraphvioError

DOCS = Path(__file__).resolve().parents[2] / "docs"
_EXPLANATION = DOCS / "explanation"
PAGES = (
    DOCS.parent / "README.md",
    _EXPLANATION / "benchmarks.md",
    *sorted((_EXPLANATION / "benchmarks").glob("*.md")),
)
"""Pages that have markers for reports."""
IMAGES = DOCS / "images"
_PACKAGES = ("numpy", "numba", "opencv-python-headless", "gtsam")


class Report:
    """Lines of Markdown, printed to stdout as they are added."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add(self, *lines: str) -> None:
        """Add lines, with an empty line after a heading and after the last line."""
        spaced = [part for line in lines for part in ((line, "") if line.startswith("#") else (line,))]
        for line in (*spaced, ""):
            print(line)
            self._lines.append(line)
        sys.stdout.flush()

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table; the first column is aligned left, and columns of figures are aligned right."""
        widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
        figures = [all(_is_figure(row[i]) for row in rows) for i in range(len(head))]

        def line(cells: Sequence[str]) -> str:
            parts = [c.rjust(w) if f else c.ljust(w) for c, w, f in zip(cells, widths, figures, strict=True)]
            return f"| {' | '.join(parts)} |"

        rule = [f"{'-' * (w - 1)}:" if f else "-" * w for w, f in zip(widths, figures, strict=True)]
        self.add(line(head), f"| {' | '.join(rule)} |", *(line(row) for row in rows))

    @property
    def text(self) -> str:
        """The whole text, with a newline at the end."""
        return "\n".join(self._lines).rstrip() + "\n"

    def save(self, path: Path) -> None:
        """Write the report to a file; its folder is created if it is missing.

        Raises:
            GraphvioError: if the file cannot be written.
        """
        with writing(path):
            path.write_text(self.text, encoding="utf-8")

    def write(self, args: argparse.Namespace, name: str) -> None:
        """Write the report to the file of ``--out`` and, with ``--docs``, between the markers of a name in the docs."""
        if args.out is not None:
            self.save(args.out)
        if args.docs:
            self.save_to_docs(name)

    def save_to_docs(self, name: str, extra: str = "") -> None:
        """Replace the text between ``<!-- name -->`` and ``<!-- /name -->`` in README and the pages of benchmarks.

        Args:
            name: name of the markers; every page with these markers gets the report.
            extra: Markdown that follows the report, such as the link to a picture.

        Raises:
            GraphvioError: if no page has the markers, or one has them twice.
        """
        begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
        marker = re.compile(f"{re.escape(begin)}\n.*?{re.escape(end)}", re.DOTALL)
        inside = f"{begin}\n{self.text}\n{extra}\n{end}" if extra else f"{begin}\n{self.text}{end}"
        changed = {}
        for page in PAGES:
            text = page.read_text(encoding="utf-8")
            if (count := len(marker.findall(text))) > 1:
                raise GraphvioError(f"{page.name}: has {begin} {count} times; leave one")
            if count == 1:
                changed[page] = marker.sub(lambda _: inside, text)
        if not changed:
            raise GraphvioError(f"docs/explanation/benchmarks: a page needs {begin} and after it {end}, a line each")
        for page, text in changed.items():
            page.write_text(text, encoding="utf-8")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Create the folder of a file that is written within the block; an `OSError` becomes a `GraphvioError`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise GraphvioError(f"{path}: cannot be written ({error.strerror}); choose another place") from None


def log_progress(text: str) -> None:
    """Print one line about progress to stderr."""
    print(text, file=sys.stderr, flush=True)


def machine() -> str:
    """Return a line about the machine: processor, cores, load and versions."""
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
