"""The report of a calibration: an HTML page, its figures, and all numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.calibration.pair_calibration import PairCalibration, size_in_words
from graphvio.calibration.report import figures
from graphvio.calibration.report.document import write_document
from graphvio.calibration.result import Calibration
from graphvio.errors import CalibrationError, writing
from graphvio.reporting.figures import png
from graphvio.reporting.html import render

PAGE, NUMBERS = "report.html", "calibration.yaml"


def write_report(found: Calibration, folder: Path, source: str, count: int) -> Path:
    """Write ``report.html`` with its figures embedded, the figures as PNG files, and all numbers as YAML.

    Args:
        found: the calibration.
        folder: folder for the report; created if missing.
        source: name of what was calibrated, for the title.
        count: number of framesets used, or of the first trajectory's poses.

    Raises:
        CalibrationError: if the folder cannot be written.
    """
    unit = "framesets" if found.rig is not None else "poses"
    pictures = {pair: _pictures(each, count, unit) for pair, each in found.places.pairwise.items()}
    with writing(folder, CalibrationError, "choose another place"):
        folder.mkdir(parents=True, exist_ok=True)
        for (i, j), named in pictures.items():
            for name, data in named.items():
                (folder / f"{name}-{i}-{j}.png").write_bytes(data)
        (folder / PAGE).write_text(page(found, pictures, source), encoding="utf-8")
    write_document(found, folder / NUMBERS)
    return folder / PAGE


def _pictures(each: PairCalibration, count: int, unit: str) -> dict[str, bytes]:
    made = {
        "alignment_errors": figures.alignment_errors(each),
        "residuals": figures.residuals(each),
        "turning": figures.turning(each),
    }
    if len(each.growth) > 1:
        made["growth"] = figures.growth(each, count, unit)
    return {name: png(figure) for name, figure in made.items()}


def page(found: Calibration, pictures: dict[tuple[int, int], dict[str, bytes]], source: str) -> str:
    """Return the HTML page of a calibration; ``pictures`` maps (first, second) -> name -> PNG."""
    has_rig = found.rig is not None
    return render(
        "calibration/report/page.html",
        found=found,
        pictures=pictures,
        source=source,
        places=[_place(found, j) for j in range(1, len(found.names))],
        places_head=("left cameras", "offset x, y, z", "rotation vector", "in the rig file")
        if has_rig
        else ("", "offset x, y, z", "rotation vector", ""),
        loops=[
            (" - ".join(found.names[k] for k in loop.cameras), size_in_words(loop.error), f"{loop.statistic:.1f} of 6")
            for loop in found.places.loops
        ],
        distances=[
            (f"{found.names[i]} and {found.names[j]}", f"{distance:.1f} of 6")
            for (i, j), distance in found.places.distances.items()
        ],
        imu=[
            (
                found.names[j],
                f"{np.rad2deg(np.linalg.norm(each.misrotation)):.3f} +- "
                f"{np.rad2deg(np.sqrt(np.linalg.eigvalsh(each.covariance)[-1])):.3f} degrees",
                f"{1e3 * each.time_offset_s:.2f} +- {1e3 * each.time_offset_sigma_s:.2f} ms "
                f"(rig: {1e3 * each.rig_time_offset_s:.2f})",
            )
            for j, each in (found.imu or {}).items()
        ],
        clocks=[
            (
                f"{found.names[i]} to {found.names[j]}",
                f"{1e-9 * clock.relation.offset_ns:.6f} +- {clock.offset_sigma_s:.6f} s",
                f"{1e6 * clock.relation.drift:.0f} +- {1e6 * clock.drift_sigma:.0f} microseconds per second",
            )
            for (i, j), clock in (found.clocks or {}).items()
        ],
        matrices=_matrices(found),
        size=size_in_words,
        degrees=lambda radians: ", ".join(f"{value:.2f}" for value in np.rad2deg(radians)) + " degrees",
        millimetres=lambda metres: " and ".join(f"{1e3 * value:.2f}" for value in metres),
        sigmas=_sigmas,
        exp=np.exp,
    )


def _place(found: Calibration, j: int) -> Sequence[str]:
    shown, rig = found.pose_summary(j), found.compare_rig(j)
    in_rig_file = ""
    if rig is not None:
        agreement = "is off" if rig.is_off else "agrees"
        in_rig_file = f"{agreement}: {size_in_words(rig.tangent)} away{rig.reliability}"
    return (
        f"{found.names[0]}, seen from {found.names[j]}",
        _vector(1e3 * shown.offset_m, 1e3 * shown.offset_sigmas_m, shown.offset_known, "mm", 2),
        _vector(np.rad2deg(shown.turn_rad), np.rad2deg(shown.turn_sigmas_rad), shown.turn_known, "degrees", 3),
        in_rig_file,
    )


def _vector(values: Float, sigmas: Float, known: Bool, unit: str, digits: int) -> str:
    parts = ", ".join(
        f"{value:.{digits}f} +- {sigma:.{digits}f}" if is_known else "unknown"
        for value, sigma, is_known in zip(values, sigmas, known, strict=True)
    )
    return f"{parts} {unit}"


def _sigmas(each: PairCalibration) -> str:
    covariances = (each.covariance, each.resampled_covariance, each.comparison.paper_covariance)
    largest = [np.sqrt(np.diag(covariance)).reshape(2, 3).max(axis=1) for covariance in covariances]
    rotations = "; ".join(f"{np.rad2deg(rotation):.4f}" for rotation, _ in largest)
    translations = "; ".join(f"{1e3 * translation:.2f}" for _, translation in largest)
    return f"{rotations} degrees, {translations} mm"


def _matrices(found: Calibration) -> Iterator[tuple[str, str]]:
    for j in range(1, len(found.names)):
        name = f"{found.names[j]}_T_{found.names[0]} (left cameras)"
        yield name, _matrix(found.places.left_T_left1[j])
        yield f"{name}, by the paper's method", _matrix(found.places.pairwise[0, j].paper_left2_T_left1)


def _matrix(values: Float) -> str:
    return "\n".join("  ".join(f"{value: .12f}" for value in row) for row in values)
