"""Benchmark of image retrieval: how often images of the same view are among those that look most alike."""

from __future__ import annotations

import tempfile
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from benchmarks.optimize_recorded import Optimized
from benchmarks.report import Report, log_progress
from graphvio.arrays import AnyArray, Bool, Float
from graphvio.config import Config
from graphvio.evaluation import MAX_GAP_S
from graphvio.optimization.loops.colmap_library import colmap
from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.optimization.loops.places import choose_places
from graphvio.optimization.loops.retrieval import describe, vocabulary

FIRST = (1, 3, 5, 10)
WORDS = (32, 64, 128)
_NEAR_M, _ALIKE_DEG = 1.0, 30.0
_TREE_WORDS, _TREE_ITERATIONS, _TREE_SAMPLE = 2048, 15, 40_000
_TREE_THREADS = 2


class _Views(NamedTuple):
    """The left images of a recording's places.

    Attributes:
        names: names of the N images.
        descriptors: descriptors of each image, (K, 128).
        is_allowed: (N, N) whether a query by the row's image may return the column's: whether they are apart in time.
        shows_the_same: (N, N) whether both show the same, so that the query should return it.
    """

    names: list[str]
    descriptors: list[AnyArray]
    is_allowed: Bool
    shows_the_same: Bool


def add_retrieval(report: Report, runs: dict[str, Optimized]) -> None:
    """Measure retrieval on recordings that were optimised."""
    rows = []
    config = Config()
    for name, run in runs.items():
        views = _views(run, config)
        asked = int(views.shows_the_same.any(axis=1).sum())
        for words in WORDS:
            start = perf_counter()
            similarity = _by_vlad(views, words, config.motion.seed)
            rows.append(_row(name, f"VLAD, {words} words", views, similarity, perf_counter() - start))
        similarity, seconds = _by_tree(run, views)
        rows.append(_row(name, f"pycolmap, {_TREE_WORDS} words", views, similarity, seconds))
        log_progress(f"  {name}: {len(views.names)} images, {asked} of them with others that show the same")
    report.add(
        "### Retrieval",
        f"Images of the places, each asked for those more than {config.optimization.loop_interval_s:g} s away. Two "
        f"show the same where the cameras are less than {_NEAR_M:g} m apart and look less than {_ALIKE_DEG:g} "
        "degrees aside of each other. *Recall at N* is the share, of the images that have such others, for which one "
        "of these is among the first N. Time in s of all images, vocabulary included; `pycolmap.VisualIndex` uses "
        f"{_TREE_THREADS} threads, with a vocabulary of {_TREE_WORDS} words from the same number of descriptors. "
        "64-word VLAD is what is used.",
    )
    report.table(["recording", "by", "images", "asked", *(f"at {first}, %" for first in FIRST), "time, s"], rows)


def _views(run: Optimized, config: Config) -> _Views:
    settings, record, rig = config.optimization, run.found.sessions[0].record, run.session.source.rig
    stamps = record.stamps_ns[choose_places(record, settings.place_distance_m, settings.place_angle_deg)]
    truth, _ = run.truth.at(stamps, MAX_GAP_S)
    names, descriptors, cameras, at_ns = [], [], [], []
    with FeatureDatabase(run.folder / "database.db") as database:
        for stamp_ns, world_T_body in zip(truth.stamps_ns.tolist(), truth.nav_T_body, strict=True):
            for pair in rig.pairs:
                name = image_name(run.session.name, pair.left.name, stamp_ns)
                if name in database.names:
                    names.append(name)
                    descriptors.append(database.descriptors(name))
                    cameras.append(world_T_body @ pair.left.body_T_cam)
                    at_ns.append(stamp_ns)
    poses, times = np.array(cameras), np.array(at_ns)
    apart_m = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    ahead = poses[:, :3, 2]
    aside_deg = np.rad2deg(np.arccos(np.clip(ahead @ ahead.T, -1.0, 1.0)))
    is_allowed = np.abs(times[:, None] - times[None]) > 1e9 * settings.loop_interval_s
    return _Views(names, descriptors, is_allowed, is_allowed & (apart_m < _NEAR_M) & (aside_deg < _ALIKE_DEG))


def _by_vlad(views: _Views, words: int, seed: int) -> Float:
    centres = vocabulary(views.descriptors, len(views.descriptors), seed, words)
    vectors = np.array([describe(rows, centres) for rows in views.descriptors])
    return np.asarray(vectors @ vectors.T, dtype=np.float64)


def _by_tree(run: Optimized, views: _Views) -> tuple[Float, float]:
    """Return the similarity (N, N) by COLMAP's index, and the time for computing it, seconds.

    ``VisualIndex.query`` cannot return its results to Python, so COLMAP's generator of image pairs is used. It takes
    the images from a database, so a database with only the left images is made.
    """
    library = colmap()
    with tempfile.TemporaryDirectory() as folder, FeatureDatabase(Path(folder) / "left.db") as left:
        _copy_left(run, views, left)
        start = perf_counter()
        index = library.VisualIndex.create(128, 64)
        building = library.VisualIndex.BuildOptions()
        building.num_visual_words, building.num_iterations, building.num_rounds = _TREE_WORDS, _TREE_ITERATIONS, 1
        building.num_threads = _TREE_THREADS
        index.build(building, library.FeatureDescriptorsFloat(library.FeatureExtractorType.SIFT, _sample(views)))
        path = Path(folder) / "vocabulary.bin"
        index.write(path)
        options = library.VocabTreePairingOptions()
        options.vocab_tree_path, options.num_images, options.num_threads = path, len(views.names), _TREE_THREADS
        ranked = library.Database.open(left.path)
        number = {ranked.read_image_with_name(name).image_id: k for k, name in enumerate(views.names)}
        similarity = np.full((len(number), len(number)), -np.inf)
        pairs = library.VocabTreePairGenerator(options, ranked, list(number))
        while not pairs.has_finished():
            for rank, (asking, answer) in enumerate(pairs.next()):
                similarity[number[asking], number[answer]] = -rank
        seconds = perf_counter() - start
        ranked.close()
    return similarity, seconds


def _copy_left(run: Optimized, views: _Views, left: FeatureDatabase) -> None:
    rig_id, cameras = left.add_rig(run.session.source.rig)
    with FeatureDatabase(run.folder / "database.db") as whole:
        for name, descriptors in zip(views.names, views.descriptors, strict=True):
            left.add_place(rig_id, {cameras[name.rsplit("/", 2)[1]]: name})
            left.add_features(name, whole.pixels(name), descriptors)


def _sample(views: _Views) -> AnyArray:
    each = max(1, _TREE_SAMPLE // len(views.descriptors))
    rng = np.random.default_rng(0)
    chosen = [rows[rng.choice(len(rows), min(each, len(rows)), replace=False)] for rows in views.descriptors]
    return np.concatenate(chosen).astype(np.float32)


def _row(name: str, by: str, views: _Views, similarity: Float, seconds: float) -> list[str]:
    asked = np.flatnonzero(views.shows_the_same.any(axis=1))
    hits = dict.fromkeys(FIRST, 0)
    for k in asked.tolist():
        order = np.argsort(-np.where(views.is_allowed[k], similarity[k], -np.inf), kind="stable")
        for first in FIRST:
            hits[first] += bool(views.shows_the_same[k][order[:first]].any())
    shares = [f"{100 * hits[first] / max(len(asked), 1):.1f}" for first in FIRST]
    return [name, by, f"{len(views.names)}", f"{len(asked)}", *shares, f"{seconds:.1f}"]
