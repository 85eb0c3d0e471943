import importlib
import json
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from graphvio.version import __version__

doctor: Any = importlib.import_module("graphvio.cli.doctor")


def output(*arguments: str) -> str:
    app = typer.Typer()
    app.command()(doctor.doctor)
    result = CliRunner().invoke(app, list(arguments), env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    return result.output


def test_table_names_versions_cores_and_cache() -> None:
    shown = output()
    for word in ("graphvio", __version__, "python", "gtsam", "numba", "opencv", "cores", "kernel cache"):
        assert word in shown
    assert "missing" not in shown


def test_json_can_be_read_by_programs() -> None:
    findings = json.loads(output("--json"))
    assert findings["versions"]["graphvio"] == __version__
    assert findings["cores"]["usable"] >= 1
    assert all(findings["versions"].values())


def test_absent_parts_come_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "find_spec", lambda _: None)
    assert "pip install 'graphvio[viewer]'" in output()
    assert "pip install 'graphvio[maps]'" in output()


def test_state_of_the_kernel_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from graphvio import kernels

    monkeypatch.setattr(kernels, "cache_root", lambda: tmp_path)
    empty = doctor.examine()["kernel_cache"]
    assert empty["folder"] == str(tmp_path)
    assert empty["files"] == 0
    assert not any(empty["compiled_modules"].values())
    folder = tmp_path / kernels.source_digest("graphvio.geometry") / "x"
    folder.mkdir(parents=True)
    (folder / "skew.nbc").write_bytes(bytes(100))
    found = doctor.examine()["kernel_cache"]
    assert found["files"] == 1
    assert found["compiled_modules"]["graphvio.geometry"]
    assert "compiles when first used" in output()


def test_modules_with_kernels_are_found() -> None:
    modules = doctor.kernel_modules()
    assert {"graphvio.geometry", "graphvio.cameras"} <= set(modules)
    assert "graphvio.kernels" not in modules
