"""The cases that are run, and the lines that each gives: name, digest, and a figure for human readers."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

from fingerprints.digests import joined, of_archives, of_files, of_session, of_texts

SCENES = ("room", "corridor", "calibration")
_CLIP = Path(__file__).parents[3] / "shared" / "data" / "euroc_mh01_clip"
_SECONDS = "20"
_EXIT_CODES = (0, 3)  # accepted ones; 3 means that a result is incomplete

Line = tuple[str, str, str]
Case = Callable[[Path, Path], list[Line]]
"""A function that runs a case: its arguments are a recording and an empty folder, its result the lines."""


def cases() -> dict[str, Case]:
    """Return all cases by name: command, recording and, for the odometry, profile and sensors, separated by slashes."""
    recordings = ("euroc", *SCENES)
    found: dict[str, Case] = {
        f"odometry/{recording}/{profile}/{sensors}": partial(_odometry, ["--config", profile, *options])
        for recording in recordings
        for profile in ("default", "paper", "fast")
        for sensors, options in (("imu", []), ("vision", ["--no-imu"]))
    }
    found |= {f"run/{recording}": _run for recording in recordings}
    return found | {"calibrate/calibration": _calibrate, "optimize/room": _optimize}


def lines_of(name: str, recordings: Path) -> list[Line]:
    """Run a case and return its lines; if it fails or its recording is missing, a line that says so."""
    scene = name.split("/")[1]
    recording = _CLIP if scene == "euroc" else recordings / scene
    if not recording.is_dir():
        return [(name, "skipped", f"{recording.name} is not there")]
    with tempfile.TemporaryDirectory(prefix="fingerprint-") as scratch:
        try:
            lines = cases()[name](recording, Path(scratch))
        except (OSError, RuntimeError, ValueError) as error:
            return [(name, "failed", " ".join(str(error).split()))]
    return [(f"{name}/{result}", digest, figure) for result, digest, figure in lines]


def render(scene: str, recordings: Path) -> Line:
    """Return the line with the digest of a scene's recording, which is rendered if it is missing.

    Raises:
        RuntimeError: if the scene cannot be rendered.
    """
    folder = recordings / scene
    if not folder.is_dir():
        with tempfile.TemporaryDirectory(prefix=f".{scene}-", dir=recordings) as unfinished:
            made = Path(unfinished, scene)
            _graphvio("simulate", scene, "--out", made, "--duration", _SECONDS)
            made.rename(folder)
    return f"simulate/{scene}", of_files(folder), f"{sum(path.is_file() for path in folder.rglob('*'))} files"


def _graphvio(*arguments: str | Path) -> str:
    """Run a graphvio command and return its standard output."""
    command = [Path(sys.executable).with_name("graphvio"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in _EXIT_CODES:
        raise RuntimeError(f"exit code {done.returncode}: {done.stderr.strip()[-200:]}")
    return done.stdout


def _run(recording: Path, scratch: Path) -> list[Line]:
    out = scratch / "out"
    _graphvio("run", recording, "--out", out, "--to", _SECONDS)
    return _tables(out)


def _odometry(options: list[str], recording: Path, scratch: Path) -> list[Line]:
    """Run the odometry in an optimisation without loop closures, which stores its results with all digits."""
    out = scratch / "out"
    _graphvio("optimize", recording, "--no-loops", "--out", out, "--to", _SECONDS, *options)
    return _optimized(out)


def _calibrate(recording: Path, scratch: Path) -> list[Line]:
    _graphvio("calibrate", recording, "--out", scratch / "rig.yaml")
    files = sorted(scratch.glob("*.yaml"))
    return [(file.stem, of_texts([file]), f"{len(file.read_text().split())} words") for file in files]


def _optimize(recording: Path, scratch: Path) -> list[Line]:
    session, out = scratch / "session.mcap", scratch / "out"
    _graphvio("record", recording, "--out", session)
    loops = re.search(r"\d+ loop closures found, \d+ used", _graphvio("optimize", session, "--out", out))
    return [
        ("session", of_session(session), ""),
        *_optimized(out),
        ("map", of_files(out / "colmap", "*.bin"), loops.group() if loops else ""),
    ]


def _optimized(out: Path) -> list[Line]:
    """Return the lines of an optimisation's results: the odometry's states with all digits, tables, the solution."""
    (odometry,) = out.glob("*/odometry")
    archives = list(out.rglob("*.npz"))
    solution = [path for path in out.iterdir() if path.suffix in (".txt", ".csv", ".g2o")]
    return [
        ("states", of_archives(archives), f"{len(archives)} files"),
        *_tables(odometry),
        ("solution", of_texts(solution), f"{len(solution)} files"),
    ]


def _tables(odometry: Path) -> list[Line]:
    """Return the lines of the odometry's tables, which have nine decimals of poses and ten digits of all else."""
    tables = [*odometry.glob("*.txt"), *odometry.glob("*.csv")]
    summary = json.loads((odometry / "summary.json").read_text())
    error = (summary.get("evaluation") or {}).get("ate_position_m", {})
    ate = f", ATE {1e3 * error['rmse']:.4f} mm" if "rmse" in error else ""
    events = [json.loads(line) for path in odometry.glob("*.jsonl") for line in path.read_text().splitlines()]
    kinds = Counter(str(event.get("kind")) for event in events)
    return [
        ("tables", of_texts(tables), f"{summary.get('estimated')} poses{ate}"),
        ("events", joined(f"{kind} {count}".encode() for kind, count in kinds.items()), f"{len(events)}"),
    ]
