"""A map on disk: a folder with the places, their poses and features, and the pose graph.

``map.json`` is the header, with the version and the digests of the other files; ``map.npz`` has the places and chains,
``closures.npz`` the closures, ``features.db`` (COLMAP's database) the features, ``rig.yaml`` the rig. Images are not
saved: several closures from features alone locate a session as well as registered patches would, in a third of the
space.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from graphvio.arrays import AnyArray, Float
from graphvio.config import Config
from graphvio.errors import GraphvioError, MapError, writing
from graphvio.mapping.chains import Chains
from graphvio.mapping.pose_graph import PoseGraph, TestedClosure
from graphvio.mapping.recognition import Recognition
from graphvio.mapping.store import DATABASE, PlaceStore
from graphvio.optimization.loops.closures import LoopClosure, Place, closures_to_bytes, load_closures
from graphvio.rig import Rig
from graphvio.rig_files import load_rig, save_rig
from graphvio.version import __version__

FORMAT, VERSION = "graphvio map", 3
_HEADER, _RIG, _PLACES, _CLOSURES = "map.json", "rig.yaml", "map.npz", "closures.npz"
_DIGESTED = (_PLACES, _CLOSURES, DATABASE)
_OWN = (_HEADER, _RIG, *_DIGESTED)
_RIG_TOLERANCE = 1e-9  # a file has all digits, so that only rounding differs


class SavedMap(NamedTuple):
    """The contents of a map."""

    graph: PoseGraph
    recognition: Recognition
    places: Sequence[Place]  # the places of the graph, and possibly one more
    body_T_camera: Sequence[Float]  # (4, 4) pose of the first camera, with the calibration in force at each place


def save(kept: SavedMap, store: PlaceStore, rig: Rig, folder: Path) -> None:
    """Write a map atomically; an older map is replaced, other files in the folder stay."""
    check_target(folder)
    folder = folder.resolve()  # a folder is replaced, not a link to it
    with writing(folder, MapError, "choose another place, or make room"):
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            _write(kept, store, rig, made)
            if folder.exists():
                old = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
                folder.replace(old / folder.name)
                made.replace(folder)
                _move_others(old / folder.name, folder)
                shutil.rmtree(old)
            else:
                made.replace(folder)
        finally:
            shutil.rmtree(made, ignore_errors=True)


def check_map(folder: Path) -> None:
    """Raise a `MapError` unless a folder contains a map of this version; `load` checks its rig and digests."""
    _header(folder)


def load(folder: Path, rig: Rig, config: Config) -> SavedMap:
    """Read a map.

    Args:
        folder: Folder that a map was saved in.
        rig: Rig of the session that is to be located in it.
        config: Configuration with the settings of places and closures.

    Raises:
        MapError: If the folder contains no map, a map of another version or rig, or a damaged one.
    """
    header = _header(folder)
    try:
        other = load_rig(folder / _RIG)
    except GraphvioError as error:
        raise MapError(f"{folder}: the map's rig cannot be read ({error}); restore the folder") from None
    differs = _difference(rig, other)
    if differs:
        raise MapError(
            f"{folder}: is a map of another rig ({differs}); use the rig.yaml in it, or make a new map with this rig"
        )
    for name in _DIGESTED:
        if _digest(folder / name) != header["files"].get(name):
            raise MapError(f"{folder / name}: is damaged or missing; restore the map from a copy, or make a new one")
    try:
        with np.load(folder / _PLACES, allow_pickle=False) as file:
            columns = {name: file[name] for name in file.files}
        return _restored(columns, load_closures(folder / _CLOSURES), config)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, GraphvioError) as error:
        raise MapError(f"{folder / _PLACES}: holds no places ({error}); restore the map from a copy") from None


def check_target(folder: Path) -> None:
    """Raise a `MapError` unless a map may be written to a folder: it is new or empty, or contains a map."""
    if folder.exists() and not (folder / _HEADER).is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise MapError(f"{folder}: contains other files than a map; name another folder")


def _columns(kept: SavedMap) -> dict[str, Any]:
    """Return the columns of ``map.npz`` for N places in F fragments, with M images, and L closures."""
    graph, recognition, chains, n = kept.graph, kept.recognition, kept.graph.chains, len(kept.graph)
    pairs = [recognition.pairs(place) for place in range(n)]
    vectors = [np.zeros((0, recognition.words.size)), *(recognition.vectors(place) for place in range(n))]
    return {
        "session": np.array([place.session for place in kept.places[:n]], dtype=np.int64),  # (N,)
        "stamp_ns": np.array([place.stamp_ns for place in kept.places[:n]], dtype=np.int64),  # (N,)
        # (N, 4, 4) poses, each in its component's frame, and their covariances (N, 6, 6), tangent in body
        "map_T_body": np.array([graph.pose(k) for k in range(n)]).reshape(-1, 4, 4),
        "body_T_camera": np.array(kept.body_T_camera[:n]).reshape(-1, 4, 4),
        "covariance": np.array([graph.covariance(k) for k in range(n)]).reshape(-1, 6, 6),
        "starts": np.array(chains.first_places, dtype=np.int64),  # (F,) first place of each fragment
        "component": np.array(graph.component, dtype=np.int64),  # (F,)
        "firsts": np.array([chains.poses[place] for place in chains.first_places]).reshape(-1, 4, 4),  # ``odom_T_body``
        # from the previous place to each place
        "motions": np.array(chains.motions).reshape(-1, 4, 4),
        "motion_covariances": np.array(chains.covariances).reshape(-1, 6, 6),
        "words": recognition.words,
        "learnt_from": np.array(recognition.learnt_from),
        "vectors": np.concatenate(vectors).astype(np.float16),  # (M, D); sufficient for their ranking
        "vector_place": np.repeat(np.arange(n), [len(each) for each in pairs]),  # (M,)
        "vector_pair": np.concatenate([np.zeros(0, dtype=np.int64), *pairs]),  # (M,)
        "is_used": np.array([each.is_used for each in graph.closures], dtype=bool),  # (L,)
        "is_refuted": np.array([each.is_refuted for each in graph.closures], dtype=bool),  # (L,)
    }


def _restored(columns: Mapping[str, AnyArray], found: Sequence[LoopClosure], config: Config) -> SavedMap:
    """Restore a map from the columns that `_columns` made, and its closures."""
    motions, covariances = columns["motions"], columns["motion_covariances"]
    chains = Chains.of(columns["starts"].tolist(), columns["firsts"], motions, covariances)
    closures = [
        TestedClosure(each, bool(is_used), bool(is_refuted))
        for each, is_used, is_refuted in zip(found, columns["is_used"], columns["is_refuted"], strict=True)
    ]
    probability = config.optimization.loop_probability
    poses, bounds = list(columns["map_T_body"]), list(columns["covariance"])
    graph = PoseGraph(probability, chains, closures, poses, columns["component"].tolist(), bounds)
    recognition = Recognition(config.motion.seed, columns["words"], int(columns["learnt_from"]))
    vectors = columns["vectors"].astype(np.float32)
    for k in range(len(graph)):
        rows = np.flatnonzero(columns["vector_place"] == k)
        recognition.add_described(columns["vector_pair"][rows].tolist(), list(vectors[rows]))
    stamps = zip(columns["session"].tolist(), columns["stamp_ns"].tolist(), strict=True)
    places = [Place(session, k, stamp_ns) for k, (session, stamp_ns) in enumerate(stamps)]
    return SavedMap(graph, recognition, places, list(columns["body_T_camera"]))


def _write(kept: SavedMap, store: PlaceStore, rig: Rig, folder: Path) -> None:
    folder.chmod(0o755)
    store.copy_to(folder)
    columns = _columns(kept)
    np.savez(folder / _PLACES, **columns)
    (folder / _CLOSURES).write_bytes(closures_to_bytes([each.closure for each in kept.graph.closures]))
    save_rig(rig.with_cameras(lambda camera: replace(camera, mask=None)), folder / _RIG)  # masks are other files
    header = {
        "format": FORMAT,
        "version": VERSION,
        "graphvio": __version__,
        "rig": rig.name,
        "places": len(kept.graph),
        "sessions": len(set(columns["session"].tolist())),
        "files": {name: _digest(folder / name) for name in _DIGESTED},
    }
    (folder / _HEADER).write_text(json.dumps(header, indent=2) + "\n", encoding="utf-8")


def _move_others(folder: Path, into: Path) -> None:
    """Move the files that do not belong to a map into another folder."""
    for path in folder.iterdir():
        if path.name not in _OWN:
            try:
                path.replace(into / path.name)
            except OSError as error:
                raise MapError(f"{path}: cannot be moved to {into} ({error}); move it yourself") from None


def _header(folder: Path) -> dict[str, dict[str, str]]:
    path = folder / _HEADER
    try:
        header = json.loads(path.read_text(encoding="utf-8"))
        form, version, files = header["format"], header["version"], dict(header["files"])
    except OSError:
        raise MapError(f"{folder}: is no map, {_HEADER} is missing; give the folder that a map was saved in") from None
    except (ValueError, KeyError, TypeError):
        raise MapError(f"{path}: is damaged; restore the map from a copy, or make a new one") from None
    if form != FORMAT:
        raise MapError(f"{path}: is not the header of a map; give the folder that a map was saved in")
    if version != VERSION:
        raise MapError(f"{folder}: is a map of version {version}, this graphvio reads {VERSION}; make a new map")
    return {"files": files}


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def _difference(rig: Rig, other: Rig) -> str:
    """Describe how the cameras of two rigs differ, empty if they do not; IMU and masks are not compared."""
    names, others = [each.name for each in rig.cameras], [each.name for each in other.cameras]
    if names != others:
        return f"cameras {', '.join(names)} here, {', '.join(others)} there"
    for one, two in zip(rig.cameras, other.cameras, strict=True):
        if one.model != two.model or one.size_px != two.size_px:
            return f"{one.name} is {one.model} {one.size_px} here, {two.model} {two.size_px} there"
        for what in ("intrinsics", "distortion", "body_T_cam"):
            if not np.allclose(getattr(one, what), getattr(two, what), rtol=_RIG_TOLERANCE, atol=_RIG_TOLERANCE):
                return f"{what} of {one.name} differ"
    return ""
