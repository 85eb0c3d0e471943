"""Export of optimised sessions as COLMAP reconstructions: rigs, frames, images, and points triangulated at fixed poses.

COLMAP's world is the nav frame of the optimisation: metres, z up if there is an IMU.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Self

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import OptimizationError, writing
from graphvio.geometry import se3_inverse
from graphvio.optimization.covisibility import verify_matches
from graphvio.optimization.loops.closures import Place
from graphvio.optimization.loops.colmap_library import colmap, only_errors_logged
from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.optimization.loops.place_images import write_place
from graphvio.optimization.loops.search import SessionInput
from graphvio.optimization.optimize import Optimization

Progress = Callable[[str, int, int], None]
"""Called with the kind of item, the number of finished items and the total number."""

_IMAGES = "images"
_REFINEMENTS = 2  # COLMAP's default of 5 takes half as long again, and changes nothing by as much as 0.001 px


def export(
    optimization: Optimization,
    sessions: Sequence[SessionInput],
    database: FeatureDatabase,
    folder: Path,
    config: Config,
    on_progress: Progress = lambda *_: None,
) -> None:
    """Write images as ``images/SESSION/CAMERA/STAMP.png``, and models as ``sparse/0``, ``sparse/1`` and so on.

    Each frame of the optimisation becomes a model, as COLMAP makes one for each unconnected part; the frame with most
    places comes first. Models of an earlier export are removed.

    Args:
        optimization: the solution of the sessions, in the same order.
        sessions: the sessions, whose places are in the database.
        database: the features; neighbouring places are matched in it, and matches verified by the optimised poses.
        folder: the folder to write to, made if missing.
        config: the configuration, which gives the random seed.
        on_progress: called after each item.

    Raises:
        OptimizationError: if none of the places is in the database, or a file cannot be written.
        SourceError: if an image cannot be read.
        MissingExtraError: if the extra ``maps`` is not installed.
    """
    groups = _by_frame(optimization, sessions, database)
    if not groups:
        raise OptimizationError(
            f"{database.path}: holds no image of the sessions' places; extract their features first"
        )
    with writing(folder, OptimizationError, "is the disk full?"), _ImageWriter(sessions, database, folder) as images:
        verify_matches(optimization, sessions, database, partial(on_progress, "matches"))
        for old in (folder / "sparse").glob("*"):
            if re.fullmatch(r"\d+", old.name):
                shutil.rmtree(old)
        models = []
        for number, places in enumerate(groups):
            target = folder / "sparse" / str(number)
            target.mkdir(parents=True)
            model = _posed(optimization, sessions, places, database)
            models.append(_triangulated(model, database, folder, target, config))
            on_progress("models", number + 1, len(groups))
        images.wait(partial(on_progress, "images"))
        for number, model in enumerate(models):
            _write(model, folder / _IMAGES, folder / "sparse" / str(number))


def _names(session: SessionInput, place: Place, database: FeatureDatabase) -> list[str]:
    """Return the names of a place's images that are in the database."""
    names = [image_name(session.name, camera.name, place.stamp_ns) for camera in session.rig.cameras]
    return [name for name in names if name in database.names]


def _by_frame(
    optimization: Optimization, sessions: Sequence[SessionInput], database: FeatureDatabase
) -> list[list[Place]]:
    """Group places by frame, the frame with most places first."""
    groups: dict[int, list[Place]] = {}
    for optimized, session in zip(optimization.sessions, sessions, strict=True):
        for place in session.places:
            if _names(session, place, database):
                groups.setdefault(int(optimized.frame[place.row]), []).append(place)
    return [groups[frame] for frame in sorted(groups, key=lambda frame: (-len(groups[frame]), frame))]


class _ImageWriter:
    """Writes the images of places with a missing file, in a thread beside the triangulation, which uses one thread."""

    def __init__(self, sessions: Sequence[SessionInput], database: FeatureDatabase, folder: Path) -> None:
        self._folder = folder / _IMAGES
        self._folder.mkdir(parents=True, exist_ok=True)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="graphvio-images")
        places = [(session, place) for session in sessions for place in session.places]
        names = [_names(session, place, database) for session, place in places]  # the database is only for this thread
        self._writing = [self._pool.submit(self._write, *each) for each in zip(places, names, strict=True)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def wait(self, on_progress: Callable[[int, int], None]) -> None:
        """Wait until all images are written.

        Raises:
            SourceError: if an image cannot be read.
        """
        for done, each in enumerate(self._writing, start=1):
            each.result()
            on_progress(done, len(self._writing))

    def _write(self, of: tuple[SessionInput, Place], names: Sequence[str]) -> None:
        session, place = of
        if not all((self._folder / name).exists() for name in names):
            write_place(self._folder, session.rig, session.name, session.source.frameset_at(place.stamp_ns))


def _posed(
    optimization: Optimization, sessions: Sequence[SessionInput], places: Sequence[Place], database: FeatureDatabase
) -> Any:
    """Return a reconstruction with the poses of the places of a frame, without points."""
    rigs: dict[int, Float] = {}
    for place in places:
        session = sessions[place.session]
        body_T_nav = se3_inverse(optimization.sessions[place.session].nav_T_body[place.row])
        frame_id = database.frame_id(_names(session, place, database)[0])
        rigs[frame_id] = session.rig.cameras[0].cam_T_body @ body_T_nav
    return database.model(rigs)


def _triangulated(model: Any, database: FeatureDatabase, folder: Path, target: Path, config: Config) -> Any:
    """Triangulate the database's verified matches, with poses and cameras held fixed; points have no colours yet."""
    library = colmap()
    options = library.IncrementalPipelineOptions()
    options.num_threads = 1  # with more threads, points depend on timing
    options.random_seed = config.motion.seed
    options.image_names = sorted(image.name for image in model.images.values())
    options.load_all_images = True
    options.ba_global_max_refinements = _REFINEMENTS
    options.ba_refine_sensor_from_rig = False
    options.constant_rigs = set(model.rigs)
    options.constant_cameras = set(model.cameras)
    options.triangulation.ignore_two_view_tracks = False  # two views of a calibrated stereo pair suffice
    try:
        with only_errors_logged():  # no warnings of missing images, which are still being written
            triangulated = library.triangulate_points(model, database.path, folder / _IMAGES, target, True, options)
        triangulated.update_point_3d_errors()
    except (RuntimeError, ValueError) as error:
        raise OptimizationError(f"{target}: COLMAP cannot triangulate the places' features ({error})") from None
    return triangulated


def _write(model: Any, images: Path, target: Path) -> None:
    """Colour a model's points from the images, and write the model."""
    try:
        model.extract_colors_for_all_images(images)
        model.write(target)
    except (RuntimeError, ValueError) as error:
        raise OptimizationError(f"{target}: COLMAP cannot write the model ({error})") from None
