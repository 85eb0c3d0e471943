"""The page of platforms names the exit codes of the commands."""

import re
from pathlib import Path

from graphvio.cli import shared

PAGE = (Path(__file__).parents[1] / "docs/reference/platforms.md").read_text()


def test_the_page_has_every_exit_code() -> None:
    codes = {value for name, value in vars(shared).items() if name.startswith("EXIT_")}
    assert {int(code) for code in re.findall(r"^\| (\d+) \|", PAGE, re.MULTILINE)} == codes | {0}
