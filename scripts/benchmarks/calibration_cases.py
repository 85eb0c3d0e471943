"""The cases of the calibration-error benchmark, and their results in a CSV file, from which it can be continued."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

from benchmarks.calibration_runs import CalibrationOutcome
from benchmarks.report import writing
from graphvio.errors import GraphvioError

EXACT = 0
"""Level of calibration error of exact files."""


@dataclass(frozen=True)
class Case:
    """Settings of one run: the columns of the CSV file that identify it.

    Attributes:
        scene: name of the scene.
        duration_s: duration of the recording, or ``whole``.
        rig_change: change of the true rig during the walk, or ``none``.
        level: level of the calibration error, or `EXACT`.
        components: components of the calibration error, or ``all``.
        seed: seed with which the calibration error was sampled.
        config: profile, and the values that were set.
        pairs: pairs that were used; ``none`` if each camera is single, ``one-camera`` if only one camera is used.
        imu: whether the IMU was used, ``yes`` or ``no``.
    """

    scene: str
    duration_s: str
    rig_change: str
    level: int
    components: str
    seed: int
    config: str
    pairs: str
    imu: str

    @property
    def key(self) -> tuple[str, ...]:
        """The values of all settings as texts."""
        return tuple(str(value) for value in vars(self).values())


_SETTINGS = tuple(Case.__dataclass_fields__)
_FIGURES = (
    "ate_cm",
    "ate_scaled_cm",
    "scale_error_percent",
    "epochs",
    "posed_percent",
    "frameset_ms",
    "pose_nees",
    "before",
    "after",
)


def append_outcome(path: Path, case: Case, outcome: CalibrationOutcome) -> None:
    """Append a run to a CSV file, which is created if it is missing.

    Raises:
        GraphvioError: if the file cannot be written.
    """
    with writing(path):
        is_new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.writer(file)
            if is_new:
                writer.writerow((*_SETTINGS, *_FIGURES))
            figures = (
                f"{100 * outcome.ate_m:.4f}",
                f"{100 * outcome.ate_scaled_m:.4f}",
                f"{outcome.scale_error_percent:.4f}",
                outcome.epochs,
                f"{outcome.posed_percent:.2f}",
                f"{outcome.frameset_ms:.2f}",
                f"{outcome.pose_nees:.4f}",
            )
            writer.writerow([*case.key, *figures, _json(outcome.before), _json(outcome.after)])


def load_outcomes(path: Path) -> dict[tuple[str, ...], CalibrationOutcome]:
    """Return the runs in a CSV file by `Case.key`; of runs with the same key the last.

    Raises:
        GraphvioError: if the file has other columns.
    """
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    if rows and tuple(rows[0]) != (*_SETTINGS, *_FIGURES):
        raise GraphvioError(f"{path}: has other columns than this benchmark writes; name another file with --out")
    return {
        tuple(row[name] for name in _SETTINGS): CalibrationOutcome(
            ate_m=0.01 * float(row["ate_cm"]),
            ate_scaled_m=0.01 * float(row["ate_scaled_cm"]),
            scale_error_percent=float(row["scale_error_percent"]),
            epochs=int(row["epochs"]),
            posed_percent=float(row["posed_percent"]),
            frameset_ms=float(row["frameset_ms"]),
            pose_nees=float(row["pose_nees"]),
            before=json.loads(row["before"]),
            after=json.loads(row["after"]),
        )
        for row in rows
    }


def _json(errors: dict[str, float]) -> str:
    return json.dumps({name: round(error, 6) for name, error in errors.items()})
