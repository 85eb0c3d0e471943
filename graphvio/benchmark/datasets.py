"""Public data sets: names of the sequences, and where to find recordings, calibrations and true trajectories."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from graphvio.errors import BenchmarkError
from graphvio.sources import is_recording
from graphvio.sources.surroundings import recordings_below

_MAX_DEPTH = (
    4  # levels searched for recordings: dataset/sequences/00, M_monado_datasets/MI_valve_index/MIO_others/MIO01
)


@dataclass(frozen=True)
class Dataset:
    """A public data set."""

    key: str  # name of the data set on the command line
    title: str
    pattern: re.Pattern[str]  # searched for in the name of a recording; its groups are parts of the sequence's name
    name_format: str  # format of the sequence's name, filled with the groups
    sequences: tuple[str, ...]  # sequences with a true trajectory, in the order of the table
    calibrations: tuple[str, ...] = ()  # files or folders, in a recording or above it; ``{0}`` is the first group
    has_segments: bool = False  # whether KITTI's errors over segments of 100 to 800 m are reported, too

    def sequence_of(self, name: str) -> str | None:
        """Return the sequence that the name of a file or folder belongs to, such as ``MH_01`` of ``MH_01_easy``."""
        found = self.pattern.search(name)
        if found is None:
            return None
        sequence = self.name_format.format(*(part for part in found.groups() if part))
        return next((each for each in self.sequences if each.lower() == sequence.lower()), sequence)


@dataclass(frozen=True)
class Sequence:
    """A recording of a sequence that was found in a folder."""

    name: str  # name of the sequence, with a number if there are several recordings of it
    recording: Path
    rig: Path | None  # calibration, or None for the recording's own
    truth: Path | None = field(default=None)  # file with the true trajectory, or None for the recording's own


def _numbered(kind: str, count: int) -> tuple[str, ...]:
    return tuple(f"{kind}{number}" for number in range(1, count + 1))


DATASETS = {
    each.key: each
    for each in (
        Dataset(
            "euroc",
            "EuRoC MAV",
            re.compile(r"(MH)_?(0[1-5])|(V[12])_?(0[1-3])", re.IGNORECASE),
            "{0}_{1}",
            ("MH_01", "MH_02", "MH_03", "MH_04", "MH_05", "V1_01", "V1_02", "V1_03", "V2_01", "V2_02", "V2_03"),
        ),
        Dataset(
            "tum-vi",
            "TUM-VI",
            re.compile(r"(room[1-6]|corridor[1-5]|magistrale[1-6]|outdoors[1-8]|slides[1-3])"),
            "{0}",
            (
                *_numbered("room", 6),
                *_numbered("corridor", 5),
                *_numbered("magistrale", 6),
                *_numbered("outdoors", 8),
                *_numbered("slides", 3),
            ),
        ),
        Dataset(
            "uzh-fpv",
            "UZH-FPV, Snapdragon",
            re.compile(r"((?:indoor|outdoor)_(?:forward|45))_(\d+)_snapdragon"),
            "{0}_{1}",
            (
                *(f"indoor_forward_{number}" for number in (3, 5, 6, 7, 9, 10)),
                *(f"indoor_45_{number}" for number in (2, 4, 9, 12, 13, 14)),
                *(f"outdoor_forward_{number}" for number in (1, 3, 5)),
                "outdoor_45_1",
            ),
            calibrations=("{0}_calib_snapdragon",),
        ),
        Dataset(
            "kitti",
            "KITTI odometry",
            re.compile(r"^(\d\d)$"),
            "{0}",
            tuple(f"{number:02d}" for number in range(11)),
            has_segments=True,
        ),
        Dataset(
            "hilti-2022",
            "Hilti SLAM Challenge 2022",
            re.compile(r"exp_?(\d\d)"),
            "exp{0}",
            tuple(f"exp{number:02d}" for number in (1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 14, 15, 16, 18, 21)),
            calibrations=("rig.yaml", "calibration"),
        ),
        Dataset(
            "monado",
            "Monado SLAM datasets",
            re.compile(r"(M[GIO](?:O|P[A-Z]?)\d\d)"),
            "{0}",
            (),
            calibrations=("extras/calibration.json", "calibration.json"),
        ),
    )
}
"""Data sets by key. Monado's list of sequences is empty since the data set grows: all sequences found are run."""


def dataset_of(key: str) -> Dataset:
    """Return the data set with a key.

    Raises:
        BenchmarkError: if there is no such data set.
    """
    if key not in DATASETS:
        raise BenchmarkError(f"{key}: is no data set that graphvio knows; give one of {', '.join(DATASETS)}")
    return DATASETS[key]


def find_sequences(dataset: Dataset, folder: Path, rig: Path | None = None) -> list[Sequence]:
    """Find the sequences of a data set in a folder, and return them in the order of the data set's table.

    Args:
        dataset: the data set.
        folder: folder that holds the sequences, up to four levels below.
        rig: calibration for all sequences; None to look for it where the data set has it.

    Raises:
        BenchmarkError: if there are none.
    """
    if not folder.is_dir():
        raise BenchmarkError(f"{folder}: is no folder; give the one that holds the sequences of {dataset.title}")
    found: dict[str, list[Path]] = {}
    for recording in recordings_below(folder.resolve(), _MAX_DEPTH, is_recording):
        name = dataset.sequence_of(recording.name)
        if name is not None:
            found.setdefault(name, []).append(recording)
    if not found:
        examples = ", ".join(dataset.sequences[:3]) or "MIO01, MIPB01"
        raise BenchmarkError(
            f"{folder}: holds no recording that is named like a sequence of {dataset.title} ({examples}, ...); "
            "keep the names that its folders or bags have"
        )
    ranks = {name: rank for rank, name in enumerate(dataset.sequences)}
    return [
        Sequence(
            name if len(found[name]) == 1 else f"{name}-{number}",
            recording,
            rig if rig is not None else _calibration(dataset, recording, folder.resolve()),
            _truth(dataset, name, folder),
        )
        for name in sorted(found, key=lambda name: (ranks.get(name, len(ranks)), name))
        for number, recording in enumerate(sorted(found[name]), start=1)
    ]


def _calibration(dataset: Dataset, recording: Path, folder: Path) -> Path | None:
    """Find a recording's calibration in it, or above it up to ``folder``; None if it has its own, or there is none."""
    kind = dataset.pattern.search(recording.name)
    if (recording / "rig.yaml").is_file() or kind is None:
        return None
    place = recording
    while True:
        for name in dataset.calibrations:
            candidate = place / name.format(*kind.groups())
            if candidate.exists():
                return candidate
        if place in (folder, place.parent):
            return None
        place = place.parent


def _truth(dataset: Dataset, name: str, folder: Path) -> Path | None:
    """Find the true trajectory of Hilti's bags, which do not contain it: a text file with the sequence's name."""
    if dataset.key != "hilti-2022":
        return None
    files = sorted(file for file in folder.rglob("*.txt") if dataset.sequence_of(file.stem) == name)
    return files[0] if files else None
