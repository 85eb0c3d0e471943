import ast
import importlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphvio import kernel_cache, kernels
from graphvio.cameras import EQUIDISTANT, project_points
from graphvio.frontend.motion.resection import real_quartic_roots
from graphvio.geometry import se3_adjoint, se3_exp, se3_log

ROOT = Path(kernels.__file__).parents[1]


@pytest.fixture
def forgetful() -> Iterator[None]:
    """Nothing that `kernels` remembers of this process' environment or sources leaks in or out."""
    kernel_cache.cache_root.cache_clear()
    _forget_sources()
    yield
    kernel_cache.cache_root.cache_clear()
    _forget_sources()


def _forget_sources() -> None:
    kernel_cache.source_digest.cache_clear()
    kernel_cache._source.cache_clear()


@pytest.mark.usefixtures("forgetful")
def test_cache_root_is_the_users_choice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRAPHVIO_CACHE_DIR", str(tmp_path / "chosen"))
    assert kernel_cache.cache_root() == tmp_path / "chosen"
    assert (tmp_path / "chosen").is_dir()
    monkeypatch.delenv("GRAPHVIO_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    kernel_cache.cache_root.cache_clear()
    assert kernel_cache.cache_root() == tmp_path / "xdg" / "graphvio" / "kernels"


@pytest.mark.usefixtures("forgetful")
def test_cache_root_that_cannot_be_written_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("GRAPHVIO_CACHE_DIR", str(tmp_path / "file" / "below"))
    root = kernel_cache.cache_root()
    assert root.is_dir()
    assert tmp_path not in root.parents


def test_compiled_code_is_written_once_and_found_again(tmp_path: Path) -> None:
    program = (
        "import numpy as np; from graphvio import geometry, kernel_cache;"
        "before = kernel_cache.any_compiled_before('graphvio.geometry'); geometry.skew(np.zeros(3));"
        "print(before, sum(geometry.skew.stats.cache_hits.values()), sum(geometry.skew.stats.cache_misses.values()))"
    )
    environment = {**os.environ, "GRAPHVIO_CACHE_DIR": str(tmp_path)}
    answers = [
        subprocess.run(
            [sys.executable, "-c", program], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(2)
    ]
    assert answers == [["False", "0", "1"], ["True", "1", "0"]]
    assert [path for path in tmp_path.iterdir() if path.name.startswith("graphvio.geometry-")]


def test_compilation_progress_counts_the_kernels_in_the_cache(tmp_path: Path) -> None:
    program = (
        "import numpy as np; from graphvio import geometry, kernels; print(kernels.compilation_progress());"
        "geometry.skew(np.zeros(3)); geometry.so3_exp(np.zeros(3)); print(tuple(kernels.compilation_progress()))"
    )
    environment = {**os.environ, "GRAPHVIO_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    before, after = done.stdout.splitlines()
    compiled, total, newest = ast.literal_eval(after)
    assert before == "None"
    assert 2 <= compiled < total
    assert newest == "so3_exp"


def test_kernels_are_compiled_for_python_or_for_other_kernels_as_needed(tmp_path: Path) -> None:
    environment = {**os.environ, "GRAPHVIO_CACHE_DIR": str(tmp_path)}

    def ran(call: str) -> tuple[list[list[int]], list[str]]:
        program = (
            f"import numpy as np; from graphvio import geometry; result = {call};"
            "kernels = geometry._of_skew, geometry._of_skew._inlined, geometry.so3_exp, geometry.so3_exp._inlined;"
            "print([[each.stats.cache_misses.total(), each.stats.cache_hits.total()] for each in kernels]);"
            "print(*result.ravel())"
        )
        done = subprocess.run(
            [sys.executable, "-c", program], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
        )
        counts, result = done.stdout.splitlines()
        return ast.literal_eval(counts), result.split()

    neither, compiled, loaded = [0, 0], [1, 0], [0, 1]
    turn, pose = "geometry.so3_exp(np.arange(3.0))", "geometry.se3_exp(np.arange(6.0))"
    first = ran(turn)
    assert first[0] == [neither, compiled, compiled, neither]
    assert ran(turn) == ([neither, neither, loaded, neither], first[1])
    of_pose = ran(pose)  # which calls both
    assert of_pose[0] == [neither, loaded, neither, compiled]
    assert ran(pose) == ([neither] * 4, of_pose[1])
    assert [of_pose[1][at] for at in (0, 1, 2, 4, 5, 6, 8, 9, 10)] == first[1]


@pytest.mark.parametrize("order", [("plain", "any_order", "fast"), ("fast", "any_order", "plain")])
def test_fast_arithmetic_stays_within_the_kernels_that_ask_for_it(order: tuple[str, ...], tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    length = (
        "def {0}(values):\n"
        "    total = 0.0\n"
        "    for index in range(values.size):\n"
        "        total += values[index] ** 2\n"
        "    return total if np.isfinite(values).all() else np.max(values) ** 3\n"
    )
    report = (
        "for kernel in {0}:\n"
        "    kernel(np.ones(9))\n"
        "    code, = kernel.inspect_llvm().values()\n"
        "    flagged = re.findall(r'= (?:tail )?(f[a-z]+|call) (fast|reassoc|nsz)', code)\n"
        "    print(kernel.__name__, len(flagged), len(re.findall(r'= (?:tail )?f[a-z]+ ', code)), sep=',')\n"
    )
    decorators = {"plain": "@kernel", "any_order": "@vector_kernel", "fast": "@fast_kernel"}
    program.write_text(
        "import re, numpy as np; from graphvio.kernels import fast_kernel, kernel, vector_kernel\n"
        + "".join(f"{decorator}\n{length.format(name)}" for name, decorator in decorators.items())
        + report.format(", ".join(order))
    )
    environment = {**os.environ, "GRAPHVIO_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, program], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    counts = {name: (int(flagged), int(of)) for name, flagged, of in (row.split(",") for row in done.stdout.split())}
    assert counts["plain"][0] == 0
    assert 0 < counts["any_order"][0] < counts["any_order"][1]
    assert 0 < counts["fast"][0] < counts["fast"][1]


def test_cache_of_all_users_is_read_where_it_cannot_be_written(tmp_path: Path) -> None:
    shared, home = tmp_path / "shared", tmp_path / "home"
    environment = {**os.environ, "GRAPHVIO_CACHE_DIR": str(shared), "XDG_CACHE_HOME": str(home)}
    read_only = (
        f"import os; access = os.access; os.access = lambda path, mode: '{shared}' != str(path);"  # root may write
    )
    program = (
        "import numpy as np; from graphvio import geometry, kernel_cache;"
        "known = kernel_cache.any_compiled_before('graphvio.geometry'); geometry.skew(np.zeros(3));"
        "geometry.se3_inverse(np.eye(4));"
        "print(known, geometry.skew.stats.cache_hits.total(), geometry.se3_inverse.stats.cache_hits.total())"
    )

    def ran(text: str) -> list[str]:
        return subprocess.run(
            [sys.executable, "-c", text], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
        ).stdout.split()

    ran("import numpy as np; from graphvio import geometry; geometry.skew(np.zeros(3))")
    stored = sorted(shared.rglob("*.nbc"))
    assert stored
    assert ran(read_only + program) == ["True", "1", "0"]
    assert ran(read_only + program) == ["True", "1", "1"]  # its own, which the first run compiled
    assert sorted(shared.rglob("*.nbc")) == stored
    assert list(home.rglob("*.nbc"))


@pytest.mark.usefixtures("forgetful")
def test_digest_changes_with_whatever_is_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "graphvio"
    (package / "sub").mkdir(parents=True)
    files = {
        "top.py": "from graphvio.sub.middle import f\nfrom graphvio.sub import beside, constant\n",
        "sub/__init__.py": "constant = 1\n",
        "sub/beside.py": "",
        "sub/middle.py": "import numpy\nfrom graphvio.base import (\n    g,\n)\n",
        "base.py": "from graphvio.top import f\n",  # a circle, which must end
        "apart.py": "",
    }
    for name, text in files.items():
        (package / name).write_text(text)
    monkeypatch.setattr(kernel_cache, "_PACKAGE", package)

    def digest() -> str:
        _forget_sources()
        return kernel_cache.source_digest("graphvio.top")

    first = digest()
    assert first.startswith("graphvio.top-")
    assert digest() == first
    (package / "apart.py").write_text("x = 1\n")
    assert digest() == first
    for name in ("top.py", "sub/middle.py", "sub/__init__.py", "sub/beside.py", "base.py"):
        (package / name).write_text(files[name] + "x = 1\n")
        changed = digest()
        assert changed != first, name
        first = changed


@pytest.mark.usefixtures("forgetful")
def test_digest_of_a_real_kernel_reaches_geometry(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    read_bytes = Path.read_bytes

    def spy(path: Path) -> bytes:
        read.append(path.name)
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", spy)
    kernel_cache.source_digest("graphvio.frontend.motion.refinement")
    assert {"refinement.py", "cost.py", "geometry.py", "kernels.py", "observations.py"} <= set(read)


def test_every_import_between_modules_of_kernels_is_of_the_form_that_the_digest_reads() -> None:
    texts = {path: path.read_text() for path in (ROOT / "graphvio").rglob("*.py")}
    with_kernels = {
        path: text
        for path, text in texts.items()
        if any(f"@{decorator}" in text for decorator in ("kernel", "fast_kernel", "vector_kernel"))
    }
    assert len(with_kernels) > 10
    offenders = [
        f"{path.name}: {line}"
        for path, text in with_kernels.items()
        for line in text.splitlines()
        if line.startswith(("from .", "import graphvio"))
    ]
    assert offenders == []


def test_kernels_inline_what_they_call() -> None:
    """Else the linker would choose between copies of what they call, and the run that compiles be unlike later ones."""
    assert len(kernels._registered) > 20
    assert all(kernel.targetoptions["forceinline"] for kernel in kernels._registered)


def test_kernels_compute_what_their_python_does() -> None:
    rng = np.random.default_rng(3)
    xi = rng.standard_normal(6)
    a_T_b = se3_exp(xi)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (20, 2)), rng.uniform(-0.5, 3.0, 20)])
    lens = np.array([0.01, -0.02, 0.003, 0.001, 0.0])
    calls: list[tuple[Any, tuple[Any, ...]]] = [
        (se3_exp, (xi,)),
        (se3_log, (a_T_b,)),
        (se3_adjoint, (a_T_b,)),
        (project_points, (EQUIDISTANT, np.array([300.0, 310.0, 320.0, 240.0]), lens, points)),
        (real_quartic_roots, (np.array([1.0, -2.0, -7.0, 8.0, 12.0]),)),
    ]
    for compiled, arguments in calls:
        found, expected = compiled(*arguments), compiled.py_func(*arguments)
        for a, b in zip(np.atleast_1d(found) if isinstance(found, np.ndarray) else found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_kernels_release_the_interpreter_and_divide_by_zero_quietly() -> None:
    for module in (
        "geometry",
        "cameras",
        "frontend.motion.cost",
        "frontend.motion.refinement",
        "frontend.depth.stereo",
    ):
        for value in vars(importlib.import_module(f"graphvio.{module}")).values():
            if hasattr(value, "py_func"):
                assert value.targetoptions["nogil"]
                assert value.targetoptions["error_model"] == "numpy"
