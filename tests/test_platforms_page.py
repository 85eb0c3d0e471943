"""The page of platforms agrees with the exit codes, the extras and the workflow."""

import re
import tomllib
from pathlib import Path

import yaml

from graphvio.cli import shared

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/reference/platforms.md").read_text()


def test_the_page_has_every_exit_code() -> None:
    codes = {value for name, value in vars(shared).items() if name.startswith("EXIT_")}
    assert {int(code) for code in re.findall(r"^\| (\d+) \|", PAGE, re.MULTILINE)} == codes | {0}


def test_the_workflow_calls_only_scripts_of_the_repository() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text())
    (job,) = workflow["jobs"].values()
    assert [len(job["strategy"]["matrix"][key]) for key in ("os", "python")] == [3, 4]
    called = [step["run"] for step in job["steps"] if "run" in step]
    assert called == ["scripts/test", "scripts/check_wheel"]
    for script in called:
        assert (ROOT / script).stat().st_mode & 0o111, script
        assert f"`{script}`" in PAGE


def test_the_page_has_what_extras_leave_out() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    marked = {name: each for name, packages in extras.items() for each in packages if ";" in each}
    assert marked
    for name, package in marked.items():
        assert re.search(rf"^\| `{name}` \| {re.split('[<>=]', package)[0]} ", PAGE, re.MULTILINE), name
    assert set(re.findall(r"\w+", extras["all"][0])) >= set(extras) - {"all"}
    assert "graphvio[fleet]" in extras["s3"]
