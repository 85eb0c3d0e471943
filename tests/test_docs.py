"""What README and docs claim of code is executed or compared here."""

import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import command_line
import generate_pages
import plot_layers
import pytest
from benchmarks.report import PAGES
from calibration_walks import recorded

import graphvio
from graphvio.config import Config, profiles
from graphvio.measurements.events import EventKind
from graphvio.rig_files import load_rig

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SELF_CALIBRATION = (ROOT / "docs/how-to/self-calibration.md").read_text()


def test_the_readmes_python_runs_as_typed(room_walk: Path, tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(blocks) == 1
    (tmp_path / "recording").symlink_to(room_walk)
    (tmp_path / "rig.yaml").write_text((room_walk / "rig.yaml").read_text())
    (tmp_path / "typed.py").write_text(blocks[0])
    done = command_line.python(tmp_path / "typed.py", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("tracking") == 100


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder to work in, with a recording of turns that calibration takes."""
    folder: Path = tmp_path_factory.mktemp("docs")
    recorded(folder / "recording", 4.0)
    return folder


def test_the_python_of_self_calibration_runs_as_typed(walk: Path) -> None:
    (block,) = re.findall(r"```python\n(.*?)```", SELF_CALIBRATION, re.DOTALL)
    (walk / "typed.py").write_text(block)
    done = command_line.python(walk / "typed.py", folder=walk)
    assert done.returncode == 0, done.stderr
    assert "pair back, rotation against front: " in done.stdout
    assert "CalibrationSigmas(focal_share=" in done.stdout
    assert load_rig(walk / "rig-refined.yaml").imu is not None


@pytest.mark.usefixtures("without_plots")
def test_the_commands_of_self_calibration_run_as_typed(walk: Path) -> None:
    lines = re.findall(r"^    graphvio (.*?)(?:  +#.*)?$", SELF_CALIBRATION, re.MULTILINE)
    assert len(lines) == 3
    for line in lines:
        arguments = line.replace("RECORDING", "recording").split()
        done = command_line.graphvio(*arguments, folder=walk)
        assert done.returncode == 0, done.stderr
    for name in ("walk/calibration.png", "again/rig-refined.yaml", "rig-calibrated.yaml", "calibration/report.html"):
        assert (walk / name).exists(), name


@pytest.mark.parametrize("name", generate_pages.GENERATED)
def test_generated_pages_are_those_of_the_code(name: str) -> None:
    text = (ROOT / f"docs/reference/{name}.md").read_text()
    assert text == generate_pages.page(name), "run scripts/generate_pages.py"


def test_events_page_lists_every_kind() -> None:
    text = (ROOT / "docs/reference/events.md").read_text()
    assert [kind for kind in EventKind if f"| `{kind}` |" not in text] == []


def test_every_configuration_value_and_profile_is_documented() -> None:
    text = (ROOT / "docs/reference/configuration.md").read_text()
    config = Config()
    for stage in fields(config):
        section = text.split(f"## `{stage.name}`\n")[1].split("\n## ")[0]
        rows = re.findall(r"^\| `(\w+)` \| (\S+) \| .+ \|$", section, re.MULTILINE)
        values = getattr(config, stage.name)
        assert rows == [
            (f.name, "null" if getattr(values, f.name) is None else str(getattr(values, f.name)))
            for f in fields(values)
        ]
    for profile in profiles():
        assert f"| `{profile}` |" in text


def test_every_command_is_documented() -> None:
    text = (ROOT / "docs/reference/commands.md").read_text()
    for name in ("run", "calibrate-trajectories", "fleet optimize", "doctor"):
        assert f"\n## {name}\n" in text
    assert "| `--no-imu` |" in text


def test_every_public_name_is_in_the_reference() -> None:
    text = "".join(page.read_text() for page in (ROOT / "docs/reference/api").glob("*.md"))
    public = [name for name in graphvio.__all__ if name != "__version__" and not name.endswith("Error")]
    assert [name for name in public if f"::: graphvio.{name}\n" not in text] == []
    assert "::: graphvio.errors\n" in text


def functions_of_the_reference() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield the public functions and methods that the pages of the reference show, with their names."""
    pages = [page for page in (ROOT / "docs/reference/api").glob("*.md") if page.name != "paper.md"]
    shown = [name for page in pages for name in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE)]
    while shown:
        name = shown.pop()
        found = pkgutil.resolve_name(name)
        if inspect.isfunction(found):
            yield name, found
        elif inspect.ismodule(found) or inspect.isclass(found):
            module = found.__name__ if inspect.ismodule(found) else found.__module__
            for own, member in vars(found).items():
                member = getattr(member, "__func__", member)  # of static and class methods
                is_shown = not own.startswith("_") and getattr(member, "__module__", None) == module
                if is_shown and (inspect.isfunction(member) or inspect.isclass(member)):
                    shown.append(f"{name}.{own}")


def test_public_functions_document_arguments_results_and_errors() -> None:
    checked = 0
    for name, function in functions_of_the_reference():
        text, signature = inspect.getdoc(function) or "", inspect.signature(function)
        checked += 1
        if text.startswith("See `"):  # what implements an interface
            continue
        if set(signature.parameters) - {"self", "cls"}:
            assert "\nArgs:\n" in text, name
        if signature.return_annotation not in ("None", "Iterator[None]"):
            assert "\nReturns:\n" in text or text.startswith(("Return ", "Yield ")), name
        if re.search(r"^ +raise \w", inspect.getsource(function), re.MULTILINE):
            assert "\nRaises:\n" in text, name
    assert checked > 50


def test_every_report_of_a_benchmark_has_its_markers() -> None:
    sources = "".join(path.read_text() for path in (ROOT / "scripts").rglob("*.py"))
    names = set(re.findall(r'(?:save_to_docs\(|write\(args, )"([\w-]+)"', sources))
    assert len(names) > 15
    marked = [name for page in PAGES for name in re.findall(r"^<!-- ([\w-]+) -->$", page.read_text(), re.MULTILINE)]
    assert names - set(marked) == set()
    assert [name for name in set(marked) if marked.count(name) != (2 if name == "figures" else 1)] == []


def slug(heading: str) -> str:
    """Return the identifier of a heading, as sites of code and mkdocs make it."""
    plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain.lower()).strip())


def prose(path: Path) -> str:
    """Return a document without its blocks of code."""
    return re.sub(r"^```.*?^```", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)


def test_every_link_between_the_documents_leads_somewhere() -> None:
    documents = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.md")]
    assert len(documents) > 30
    for path in documents:
        for target, identifier in re.findall(r"\]\(([^)#:\s]*)(?:#([^)\s]*))?\)", prose(path)):
            page = path.parent / target if target else path
            assert page.exists(), f"{path.relative_to(ROOT)} links to {target}"
            if identifier:
                headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
                assert identifier in map(slug, headings), f"{path.relative_to(ROOT)} links to {target}#{identifier}"


def test_the_architecture_names_existing_modules() -> None:
    for name in re.findall(r"`([\w/]+(?:\.py|/))`", (ROOT / "docs/explanation/architecture.md").read_text()):
        assert list((ROOT / "graphvio").rglob(name)) or (ROOT / "graphvio" / name).exists(), name


def test_every_equation_has_its_functions_and_tests() -> None:
    text = (ROOT / "docs/explanation/paper.md").read_text()
    sections = re.split(r"^## ", text, flags=re.MULTILINE)[1:]
    equations = [section for section in sections if section.startswith("(")]
    assert [int(number) for each in equations for number in re.findall(r"\((\d+)\)", each.split("\n")[0])] == list(
        range(1, 14)
    )
    sources = (ROOT / "docs/reference/api/paper.md").read_text()
    for section in equations:
        links = re.findall(r"\[(\w+)\]\[([\w.]+)\]", section)
        assert any(target.startswith("graphvio.") for _, target in links), section
        assert any(target.startswith("test_") for _, target in links), section
        assert all(f"::: {target}\n" in sources for _, target in links), section


def test_the_layers_are_the_packages_that_exist() -> None:
    layered = [name for layer in plot_layers.layers() for name in layer]
    assert len(layered) == len(set(layered))
    assert set(layered) == plot_layers.packages()
