"""What README and docs claim of code is executed or compared here."""

import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import list_events
import plot_layers

from graphvio.config import Config, profiles
from graphvio.measurements.events import EventKind

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_readmes_python_runs_as_typed(room_walk: Path, tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(blocks) == 1
    (tmp_path / "recording").symlink_to(room_walk)
    (tmp_path / "rig.yaml").write_text((room_walk / "rig.yaml").read_text())
    done = subprocess.run([sys.executable, "-c", blocks[0]], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("tracking") == 100


def test_events_page_lists_every_kind() -> None:
    text = (ROOT / "docs/events.md").read_text()
    assert text == list_events.page()
    assert [kind for kind in EventKind if f"| `{kind}` |" not in text] == []


def test_every_configuration_value_is_documented() -> None:
    text = (ROOT / "docs/configuration.md").read_text()
    config = Config()
    for stage in fields(config):
        section = text.split(f"## `{stage.name}`\n")[1].split("\n## ")[0]
        rows = re.findall(r"^\| `(\w+)` \| (\S+) \| (.+) \|$", section, re.MULTILINE)
        values = getattr(config, stage.name)
        assert [(key, default) for key, default, _ in rows] == [
            (f.name, str(getattr(values, f.name))) for f in fields(values)
        ]
    for profile in profiles():
        assert f"| `{profile}` |" in text


def test_every_link_between_the_documents_leads_somewhere() -> None:
    for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\(([^)#:]+)\)", path.read_text()):
            assert (path.parent / target).exists(), f"{path.name} links to {target}"


def test_the_architecture_names_existing_modules() -> None:
    for name in re.findall(r"`([\w/]+(?:\.py|/))`", (ROOT / "docs/architecture.md").read_text()):
        assert list((ROOT / "graphvio").rglob(name)) or (ROOT / "graphvio" / name).exists(), name


def test_the_architecture_links_equations_to_existing_functions() -> None:
    text = (ROOT / "docs/architecture.md").read_text()
    links = re.findall(r"\[(\w+)\]\(\.\./(graphvio/[\w/]+\.py)\)", text)
    assert len(links) > 13
    for function, path in links:
        assert f"\ndef {function}(" in (ROOT / path).read_text(), f"{path} has no {function}"
    rows = "".join(re.findall(r"^\| (\(.*?) \|", text, re.MULTILINE))
    assert [int(number) for number in re.findall(r"\d+", rows)] == list(range(1, 14))


def test_the_layers_are_the_packages_that_exist() -> None:
    layered = [name for layer in plot_layers.layers() for name in layer]
    assert len(layered) == len(set(layered))
    assert set(layered) == plot_layers.packages()
