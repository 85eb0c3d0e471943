"""The code of documentation pages, as a reader types it."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def typed(text: str) -> list[list[str]]:
    """Return the arguments of each command of graphvio in a page's blocks."""
    lines = re.findall(r"^ {4}(?:\.venv/bin/)?graphvio (.*)$", text, re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


def python_blocks(text: str) -> list[str]:
    """Return the blocks of Python of a page."""
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)
