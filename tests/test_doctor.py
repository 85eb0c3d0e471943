import importlib
import json
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from graphvio.cli.json_output import with_json
from graphvio.version import __version__

doctor: Any = importlib.import_module("graphvio.cli.doctor")


def output(*arguments: str) -> str:
    app = typer.Typer()
    app.command()(with_json(doctor.doctor))
    result = CliRunner().invoke(app, list(arguments), env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    return result.output


def test_doctor_table_names_versions_cores_and_cache() -> None:
    shown = output()
    for word in ("graphvio", __version__, "python", "gtsam", "numba", "opencv", "cores", "kernel cache"):
        assert word in shown
    assert "missing" not in shown


def test_doctor_json_has_all_findings() -> None:
    findings = json.loads(output("--json"))
    assert findings["versions"]["graphvio"] == __version__
    assert findings["cores"]["usable"] >= 1
    assert all(findings["versions"].values())


def test_doctor_absent_parts_come_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "find_spec", lambda _: None)
    assert "pip install 'graphvio[viewer]'" in output()
    assert "pip install 'graphvio[maps]'" in output()


def test_doctor_counts_the_kernel_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from graphvio import kernel_cache

    monkeypatch.setattr(kernel_cache, "cache_root", lambda: tmp_path)
    empty = doctor.examine()["kernel_cache"]
    assert empty["folder"] == str(tmp_path)
    assert empty["files"] == 0
    assert not any(empty["compiled_modules"].values())
    folder = tmp_path / kernel_cache.source_digest("graphvio.geometry")
    folder.mkdir(parents=True)
    (folder / "skew.nbc").write_bytes(bytes(100))
    found = doctor.examine()["kernel_cache"]
    assert found["files"] == 1
    assert found["compiled_modules"]["graphvio.geometry"]
    assert "compile when first used" in output()


def test_kernel_modules_are_found() -> None:
    modules = doctor.kernel_modules()
    assert {"graphvio.geometry", "graphvio.cameras", "graphvio.kernels"} <= set(modules)
    assert "graphvio.cli.doctor" not in modules  # which only names the decorator
