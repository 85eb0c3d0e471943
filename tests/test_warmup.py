"""After the warm-up, the first framesets find every kernel compiled."""

import fcntl
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import graphvio.kernel_cache
import graphvio.kernels
import graphvio.warmup
from graphvio.arrays import Image
from graphvio.cli import app
from graphvio.config import Config
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.tracking.tracker import GroupTracker
from graphvio.simulation import default_rig
from graphvio.simulation.named_rigs import NAMED_RIGS, rig_of
from graphvio.warmup import warm_up

_FRAMES = 6


def compiled() -> set[tuple[str, str, Any]]:
    """Each kernel's module, name and signatures."""
    return {
        (kernel.py_func.__module__, kernel.py_func.__name__, signature)
        for kernel in graphvio.kernels._registered
        for signature in kernel.signatures
    }


def test_warm_up_of_a_pair_gives_each_camera_images_of_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels trust the sizes: rows that are not there would be read and written."""
    pair = default_rig().pairs[0]
    small = replace(pair.right, size_px=(400, 200), distortion=np.zeros(8))
    rig, given, observe = replace(default_rig(), pairs=(replace(pair, right=small),)), set(), GroupTracker.observe

    def noting(self: GroupTracker, stamp_ns: int, left: Image, right: Image, *others: Any) -> TrackedFrame:
        given.add((left.shape[::-1], right.shape[::-1]))
        return observe(self, stamp_ns, left, right, *others)

    monkeypatch.setattr(GroupTracker, "observe", noting)
    warm_up(rig, Config())
    assert given == {(pair.left.size_px, small.size_px)}


@pytest.mark.parametrize(
    "which", ["pairs", "few_samples", "without_imu", "pair_and_single", "rolling_pair_and_single", "singles"]
)
def test_no_kernel_is_compiled_after_the_warm_up(which: str, room_walk: Path) -> None:
    """In a process of its own, which has not run anything else; the walk lasts until the calibration is estimated."""
    ran = subprocess.run(
        [sys.executable, "-c", _WALK, which, str(room_walk)], capture_output=True, text=True, cwd=Path(__file__).parent
    )
    assert ran.returncode == 0, ran.stderr


_WALK = """
import sys
from dataclasses import replace
from test_warmup import compiled
from graphvio import ImuSample, Odometry, open_source
from graphvio.config import Config
from graphvio.simulation.calibration_error import CalibrationErrorSizes, draw
from graphvio.slam import FrontEnd
from graphvio.warmup import warm_up

which, recording = sys.argv[1:]
rig = draw(open_source(recording).rig, CalibrationErrorSizes.of_level(3, ["pair-transform"]), 1).written_rig
if which.endswith(("singles", "pair_and_single")):
    rig = rig.with_only(["0", "1", "2"])
if which.startswith("rolling"):
    rig = rig.with_cameras(lambda camera: replace(camera, line_time_us=2.0))
rig = {"singles": rig.without_pairs, "without_imu": rig.without_imu}.get(which, lambda: rig)()
warm_up(rig, Config())
before = compiled()
assert len(before) > 20
odometry, keyframes, samples = Odometry(rig), [], 0
FrontEnd(odometry).on_keyframe(keyframes.append)
for measurement in open_source(recording, rig):
    if isinstance(measurement, ImuSample):
        samples += 1
        if which == "without_imu" or (which == "few_samples" and samples % 10):
            continue
    odometry.process(measurement)
odometry.finish()
assert keyframes
assert odometry.calibration is not None and not odometry.calibration.is_file_exact
assert compiled() == before, compiled() - before
"""


@pytest.mark.parametrize(("part", "modules"), [
    ("tracking", ["graphvio.frontend.imaging.lucas_kanade", "graphvio.backend.propagation"]),
    ("motion", ["graphvio.frontend.motion.refinement", graphvio.warmup._CALIBRATION]),
])  # fmt: skip
def test_other_process_compiles_its_part(part: str, modules: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", graphvio.warmup._OTHER_PROCESS, part],
        input=pickle.dumps((default_rig(), Config())),
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == graphvio.warmup._IS_COMPILED
    assert all(map(graphvio.kernel_cache.any_compiled_before, modules))


@pytest.mark.parametrize("other_processes", ["work", "fail"])
def test_warm_up_compiles_in_parallel_and_survives_failing_processes(other_processes: str) -> None:
    """In a process of its own, which takes the kernels for uncompiled though the cache has them, to be done sooner."""
    program = f"""
from graphvio import kernels, warmup
from graphvio.config import Config
from graphvio.simulation import default_rig
if {other_processes == "fail"}:
    warmup._OTHER_PROCESS = "raise SystemExit(1)"
warmup._are_compiled = lambda *_: False
warmup.warm_up(default_rig(), Config())
print(kernels.is_compiling_elsewhere(), *[each.returncode for each in kernels._compilers])
names = [kernel.py_func.__name__ for kernel in kernels._registered if kernel.signatures]
print("register" in names, "_refined" in names, "eliminate_landmarks" in names)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    code = str(int(other_processes == "fail"))
    assert done.stdout.split() == ["False", code, code, "True", "True", "True"]


def test_compile_in_parallel_waits_for_another_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    warm_up(default_rig(), Config())
    monkeypatch.setattr(graphvio.warmup, "cache_root", lambda: tmp_path)
    monkeypatch.setattr(
        subprocess, "Popen", lambda *_, **__: pytest.fail("it compiles what the other one has compiled")
    )
    waiting = Thread(target=graphvio.warmup._compile_in_parallel, args=(default_rig(), Config()))
    with (tmp_path / "compiling.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        waiting.start()
        waiting.join(0.3)
        assert waiting.is_alive()
    waiting.join(20.0)
    assert not waiting.is_alive()


def test_warmup_command_names_the_folder_of_the_kernels() -> None:
    done = CliRunner().invoke(app, ["warmup"])
    assert done.exit_code == 0, done.output
    assert done.output.startswith(f"kernels are compiled in {graphvio.kernel_cache.cache_root()} (")
    names = {name for _, name, _ in compiled()}
    assert {"_interpolated", "rotation_from_quat_wxyz"} <= names  # which a recording with a truth needs at its end


def test_warmup_command_leaves_no_kernel_of_any_rig_to_be_compiled() -> None:
    assert CliRunner().invoke(app, ["warmup"]).exit_code == 0
    before = compiled()
    for name in NAMED_RIGS:
        warm_up(rig_of(name), Config())
    warm_up(default_rig().without_pairs(), Config())
    assert compiled() == before
