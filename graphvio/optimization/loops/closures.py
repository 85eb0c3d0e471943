"""Loop closures, in memory and on disk."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.arrays import Float, Int
from graphvio.errors import OptimizationError
from graphvio.geometry import se3_inverse
from graphvio.optimization.loops.resection import Resection

_INDEPENDENT_POINTS = 10  # errors of a lens's calibration are correlated across the image


@dataclass(frozen=True, eq=False)
class Place:
    """A keyframe whose images are searched for loop closures."""

    session: int  # number of the session
    row: int  # row of the frameset in the session's record
    stamp_ns: int  # stamp of the frameset


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """The relative pose of two places that see the same points."""

    reference: Place  # the earlier place
    current: Place  # the later one
    reference_T_current: Float  # (4, 4) motion of body
    covariance: Float  # (6, 6), tangent ``[rotation, translation]`` in body at the current place
    inliers: int  # number of points
    pairs: tuple[tuple[int, int], ...]  # (pair at the reference, pair at the current place) that saw the same points
    is_registered: bool  # whether patches were registered, not only features matched


def closure_of(earlier: Place, later: Place, found: Resection) -> LoopClosure:
    """Make a loop closure from a resection; its covariance allows for correlated errors of the points."""
    return LoopClosure(
        earlier,
        later,
        se3_inverse(found.cur_T_ref),
        found.covariance * max(1.0, found.inliers / _INDEPENDENT_POINTS) + found.shared_covariance,
        found.inliers,
        found.pairs,
        found.is_registered,
    )


def closures_to_bytes(closures: Sequence[LoopClosure]) -> bytes:
    """Return loop closures as a numpy archive; equal closures give equal bytes."""
    ends = [[(end.session, end.row, end.stamp_ns) for end in (each.reference, each.current)] for each in closures]
    crossings = [(k, a, b) for k, each in enumerate(closures) for a, b in each.pairs]
    columns: dict[str, Any] = {
        "ends": np.array(ends, dtype=np.int64).reshape(-1, 2, 3),
        "poses": np.array([each.reference_T_current for each in closures]).reshape(-1, 4, 4),
        "covariances": np.array([each.covariance for each in closures]).reshape(-1, 6, 6),
        "inliers": np.array([each.inliers for each in closures], dtype=np.int64),
        "is_registered": np.array([each.is_registered for each in closures], dtype=bool),
        "crossings": np.array(crossings, dtype=np.int64).reshape(-1, 3),
    }
    buffer = io.BytesIO()
    np.savez(buffer, **columns)
    return buffer.getvalue()


def load_closures(path: Path) -> list[LoopClosure]:
    """Read loop closures that `closures_to_bytes` made.

    Raises:
        OptimizationError: if it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            columns = {name: file[name] for name in file.files}
        crossings = columns["crossings"]
        return [
            LoopClosure(
                _place(columns["ends"][k, 0]),
                _place(columns["ends"][k, 1]),
                columns["poses"][k],
                columns["covariances"][k],
                int(columns["inliers"][k]),
                tuple((int(a), int(b)) for _, a, b in crossings[crossings[:, 0] == k]),
                bool(columns["is_registered"][k]),
            )
            for k in range(len(columns["ends"]))
        ]
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise OptimizationError(f"{path}: holds no loop closures ({error}); remove the folder") from None


def _place(row: Int) -> Place:
    session, frameset, stamp_ns = row.tolist()
    return Place(session, frameset, stamp_ns)
