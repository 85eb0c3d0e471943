"""The optimised sessions as COLMAP reconstructions: rigs, frames, images and points, the poses as they are.

What COLMAP calls the world is the nav frame of the optimisation, in metres, z up where there is an IMU.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.config import Config
from graphvio.errors import OptimizationError
from graphvio.geometry import se3_inverse
from graphvio.optimization.covisibility import verify_matches
from graphvio.optimization.loops.closures import Place
from graphvio.optimization.loops.database import FeatureDatabase, colmap, image_name
from graphvio.optimization.loops.place_images import write_image
from graphvio.optimization.loops.search import SessionInput
from graphvio.optimization.optimize import Optimization

Progress = Callable[[str, int, int], None]
"""Called with what is done, how many of it are, and how many there are."""

_THREADS = 2


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A reconstruction on disk.

    Attributes:
        folder: of its files.
        frame: number of the optimisation's frame that is its world.
        places: framesets, which are COLMAP's frames.
        images: of them.
        points: triangulated.
        observations: of all points.
        reprojection_error_px: mean over the observations; NaN without any.
    """

    folder: Path
    frame: int
    places: int
    images: int
    points: int
    observations: int
    reprojection_error_px: float

    @property
    def mean_track_length(self) -> float:
        """Images that see a point; NaN without points."""
        return self.observations / self.points if self.points else float("nan")


def export(
    optimization: Optimization,
    sessions: Sequence[SessionInput],
    database: FeatureDatabase,
    folder: Path,
    config: Config,
    on_progress: Progress | None = None,
) -> list[ColmapModel]:
    """Write ``images/SESSION/CAMERA/STAMP.png``, and ``sparse/0``, ``sparse/1`` ... with the points that they show.

    Each frame of the optimisation becomes a model of its own, that of most places the first, as unconnected models
    are with COLMAP. Models of an earlier export are removed.

    Args:
        optimization: of the sessions, in the same order.
        sessions: whose places are in the database.
        database: of features; neighbouring places are matched in it, and its matches verified by the optimised poses.
        folder: to write to; made if it is missing.
        config: its seed is used.
        on_progress: told how far it is.

    Returns:
        The models, in the order of their folders.

    Raises:
        OptimizationError: if none of the places is in the database, or a file cannot be written.
        SourceError: if an image cannot be read again.
        MissingExtraError: if the extra ``maps`` is not installed.
    """
    groups = _by_frame(optimization, sessions, database)
    if not groups:
        raise OptimizationError(
            f"{database.path}: holds no image of the sessions' places; extract their features first"
        )
    try:
        _write_images(sessions, database, folder / "images", _named(on_progress, "images"))
        verify_matches(optimization, sessions, database, _named(on_progress, "matches"))
        for old in (folder / "sparse").glob("*"):
            if re.fullmatch(r"\d+", old.name):
                shutil.rmtree(old)
        models = []
        for number, (frame, places) in enumerate(groups):
            target = folder / "sparse" / str(number)
            target.mkdir(parents=True)
            model = _triangulated(_posed(optimization, sessions, places, database), database, folder, target, config)
            models.append(_described(model, target, frame))
            _tell(on_progress, "models", number + 1, len(groups))
    except OSError as error:
        raise OptimizationError(f"{folder}: cannot be written ({error}); is the disk full?") from None
    return models


def _names(session: SessionInput, place: Place, database: FeatureDatabase) -> list[str]:
    """Of the images of a place that the database holds."""
    names = [image_name(session.name, camera.name, place.stamp_ns) for camera in session.rig.cameras]
    return [name for name in names if name in database.names]


def _by_frame(
    optimization: Optimization, sessions: Sequence[SessionInput], database: FeatureDatabase
) -> list[tuple[int, list[Place]]]:
    """Places of each frame, that of most places first."""
    groups: dict[int, list[Place]] = {}
    for optimized, session in zip(optimization.sessions, sessions, strict=True):
        for place in session.places:
            if _names(session, place, database):
                groups.setdefault(int(optimized.frame[place.row]), []).append(place)
    return sorted(groups.items(), key=lambda each: (-len(each[1]), each[0]))


def _write_images(
    sessions: Sequence[SessionInput], database: FeatureDatabase, folder: Path, on_progress: Callable[[int, int], None]
) -> None:
    """Write the images of all places that are not there yet."""
    asked = [(session, place) for session in sessions for place in session.places]

    def write(of: tuple[SessionInput, Place]) -> None:
        session, place = of
        missing = {name for name in _names(session, place, database) if not (folder / name).exists()}
        if not missing:
            return
        for j, images in session.source.frameset_at(place.stamp_ns).images.items():
            pair = session.rig.pairs[j]
            for camera, image in zip((pair.left, pair.right), images, strict=True):
                name = image_name(session.name, camera.name, place.stamp_ns)
                if name in missing:
                    write_image(folder / name, image)

    with ThreadPoolExecutor(_THREADS, thread_name_prefix="graphvio-images") as pool:
        for done, _ in enumerate(pool.map(write, asked), start=1):
            on_progress(done, len(asked))


def _posed(
    optimization: Optimization, sessions: Sequence[SessionInput], places: Sequence[Place], database: FeatureDatabase
) -> Any:
    """The reconstruction of places of one frame, without points."""
    rigs: dict[int, Float] = {}
    for place in places:
        session = sessions[place.session]
        body_T_nav = se3_inverse(optimization.sessions[place.session].nav_T_body[place.row])
        frame_id = database.frame_id(_names(session, place, database)[0])
        rigs[frame_id] = session.rig.cameras[0].cam_T_body @ body_T_nav
    return database.model(rigs)


def _triangulated(model: Any, database: FeatureDatabase, folder: Path, target: Path, config: Config) -> Any:
    """The reconstruction with the points of the database's verified matches; neither poses nor cameras change."""
    library = colmap()
    options = library.IncrementalPipelineOptions()
    options.num_threads = 1  # with more, points depend on which of them is first
    options.random_seed = config.motion.seed
    options.image_names = sorted(image.name for image in model.images.values())
    options.load_all_images = True
    options.ba_refine_sensor_from_rig = False
    options.constant_rigs = set(model.rigs)
    options.constant_cameras = set(model.cameras)
    options.triangulation.ignore_two_view_tracks = False  # a stereo pair is calibrated: two views are as good as more
    try:
        made = library.triangulate_points(model, database.path, folder / "images", target, True, options)
        made.update_point_3d_errors()
        made.write(target)
    except (RuntimeError, ValueError) as error:
        raise OptimizationError(f"{target}: COLMAP cannot triangulate the places' features ({error})") from None
    return made


def _described(model: Any, folder: Path, frame: int) -> ColmapModel:
    points = list(model.points3D.values())
    lengths = np.array([point.track.length() for point in points], dtype=np.float64)
    errors = np.array([point.error for point in points], dtype=np.float64)
    mean = float(errors @ lengths / lengths.sum()) if points else float("nan")
    return ColmapModel(
        folder, frame, model.num_frames(), model.num_images(), len(points), int(lengths.sum()), mean
    )  # fmt: skip


def _tell(on_progress: Progress | None, what: str, done: int, count: int) -> None:
    if on_progress is not None:
        on_progress(what, done, count)


def _named(on_progress: Progress | None, what: str) -> Callable[[int, int], None]:
    return lambda done, count: _tell(on_progress, what, done, count)
