"""The COLMAP export: rigs, frames, poses and points, compared with graphvio's and the true surfaces."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from calibration_walks import recorded, walk_simulator
from recordings import small_rig, with_lens

from graphvio import Config, Odometry, open_source
from graphvio.arrays import Float
from graphvio.config.stages import OptimizationConfig
from graphvio.errors import OptimizationError
from graphvio.geometry import se3_inverse
from graphvio.optimization.colmap_export import export
from graphvio.optimization.loops.closures import LoopClosure, Place
from graphvio.optimization.loops.database import FeatureDatabase, colmap_camera, image_name
from graphvio.optimization.loops.features import extract_places
from graphvio.optimization.loops.matching import alike
from graphvio.optimization.loops.places import choose_places
from graphvio.optimization.loops.search import SessionInput
from graphvio.optimization.optimize import JudgedLoop, Optimization, optimize
from graphvio.optimization.record import Recorder
from graphvio.sources import Source

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed: the extra maps")

SECONDS = 2.5
NAME = "walk"


@dataclass(frozen=True, eq=False)
class Exported:
    session: SessionInput
    optimization: Optimization
    folder: Path

    @property
    def database(self) -> Path:
        return self.folder / "database.db"

    def nav_T_body(self, stamp_ns: int) -> Float:
        optimized = self.optimization.sessions[0]
        return np.asarray(optimized.nav_T_body[np.searchsorted(optimized.record.stamps_ns, stamp_ns)])


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    folder = tmp_path_factory.mktemp("colmap")
    return export_of(open_source(recorded(folder / "recording", SECONDS)), folder)


@pytest.fixture(scope="module")
def with_a_single(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """Of a pair, and of one camera of the other pair."""
    folder = tmp_path_factory.mktemp("single")
    path = recorded(folder / "recording", SECONDS)
    return export_of(open_source(path, open_source(path).rig.with_only(["cam0", "cam1", "cam2"])), folder)


def export_of(source: Source, folder: Path) -> Exported:
    config = replace(Config(), optimization=OptimizationConfig(features=500))
    recorder = Recorder(NAME)
    odometry = Odometry(source.rig, config)
    odometry.subscribe(recorder.add)
    for measurement in source:
        odometry.process(measurement)
    odometry.finish()
    record = recorder.record()
    places = [Place(0, int(row), int(record.stamps_ns[row])) for row in choose_places(record, 0.25, 10.0)]
    session = SessionInput(NAME, source, source.rig, places, record)
    optimization = optimize([record], [source.rig.imu], [], config)
    with FeatureDatabase(folder / "database.db") as database:
        stamps = [place.stamp_ns for place in places]
        extract_places(source, source.rig, NAME, stamps, database, config)
        export(optimization, [session], database, folder, config)
    return Exported(session, optimization, folder)


@pytest.fixture
def again(exported: Exported, tmp_path: Path) -> Iterator[tuple[FeatureDatabase, Path]]:
    """The database, to be changed, and a folder."""
    shutil.copy(exported.database, tmp_path)
    with FeatureDatabase(tmp_path / exported.database.name) as database:
        yield database, tmp_path


def read(exported: Exported) -> Any:
    return read_model(exported.folder, 0)


def read_model(folder: Path, number: int) -> Any:
    return pycolmap.Reconstruction(folder / "sparse" / str(number))


def test_export_rig_frames_and_images_are_the_database_s(exported: Exported) -> None:
    model, rig = read(exported), exported.session.rig
    assert model.num_rigs() == 1
    assert model.num_reg_frames() == len(exported.session.places)
    assert model.num_reg_images() == len(exported.session.places) * len(rig.cameras)
    database = pycolmap.Database.open(exported.database)
    for image in database.read_all_images():
        kept = model.image(image.image_id)
        assert (kept.name, kept.camera_id, kept.frame_id) == (image.name, image.camera_id, image.frame_id)
        assert kept.num_points2D() == database.num_keypoints_for_image(image.image_id)
    database.close()


def test_export_cameras_are_the_rig_s(exported: Exported) -> None:
    """COLMAP's origin is the image's corner, half a pixel off."""
    model = read(exported)
    for number, camera in zip(sorted(model.cameras), exported.session.rig.cameras, strict=True):
        kept = model.camera(number)
        assert kept.model_name == "OPENCV"
        assert (kept.width, kept.height) == camera.size_px
        np.testing.assert_array_equal(kept.params[:4] - [0.0, 0.0, 0.5, 0.5], camera.intrinsics)
        np.testing.assert_array_equal(kept.params[4:], camera.distortion[:4])


@pytest.mark.parametrize(
    ("model", "of_colmap"),
    [("rational", "FULL_OPENCV"), ("extended-unified", "EUCM"), ("equidistant", "OPENCV_FISHEYE")],
)
def test_colmap_camera_projects_as_the_rig_s(model: str, of_colmap: str) -> None:
    camera = small_rig(1).cameras[0]
    if model == "equidistant":
        camera = replace(camera, model=model, distortion=np.array([0.01, -0.02, 0.003, -0.004]))
    else:
        camera = with_lens(small_rig(1), model).cameras[0]
    made = colmap_camera(camera, 1)
    assert made.model_name == of_colmap
    points = np.array([[0.1, 0.2, 1.0], [-0.4, 0.3, 1.2], [0.0, 0.0, 2.0]])
    pixels, _ = camera.project(points)
    np.testing.assert_allclose(made.img_from_cam(points) - 0.5, pixels, atol=1e-9)


@pytest.mark.parametrize("model", ["double-sphere", "omnidirectional"])
def test_colmap_camera_of_an_unknown_lens_raises(model: str) -> None:
    with pytest.raises(OptimizationError, match=f"camera cam0: COLMAP has no model for its {model} lens; .*calibrate"):
        colmap_camera(with_lens(small_rig(1), model).cameras[0], 1)


def test_export_poses_are_the_optimisation_s(exported: Exported) -> None:
    cameras = {camera.name: camera for camera in exported.session.rig.cameras}
    for image in read(exported).images.values():
        _, camera, file = image.name.split("/")
        expected = cameras[camera].cam_T_body @ se3_inverse(exported.nav_T_body(int(Path(file).stem)))
        np.testing.assert_allclose(image.cam_from_world().matrix(), expected[:3], rtol=0.0, atol=1e-9)


def test_export_points_have_many_observations_within_a_pixel(exported: Exported) -> None:
    model = read(exported)
    assert [path.name for path in (exported.folder / "sparse").iterdir()] == ["0"]
    lengths = np.array([point.track.length() for point in model.points3D.values()])
    mean_px = float(lengths @ [point.error for point in model.points3D.values()]) / float(lengths.sum())
    assert mean_px < 0.5
    assert model.compute_num_observations() > 3.0 * model.num_points3D()
    errors = []
    for image in model.images.values():
        camera = exported.session.rig.cameras[sorted(model.cameras).index(image.camera_id)]
        seen = [each for each in image.points2D if each.has_point3D()]
        points = np.array([model.point3D(each.point3D_id).xyz for each in seen])
        cam_T_world = image.cam_from_world().matrix()
        pixels, _ = camera.project(points @ cam_T_world[:, :3].T + cam_T_world[:, 3])
        errors += np.linalg.norm(pixels + 0.5 - [each.xy for each in seen], axis=1).tolist()
    assert len(errors) == model.compute_num_observations() == lengths.sum()
    assert np.mean(errors) == pytest.approx(mean_px, rel=1e-6)


def test_export_points_lie_on_true_surfaces(exported: Exported) -> None:
    errors = depth_errors(exported, 0, 1, 2, 3)
    assert len(errors) > 1000
    assert np.median(np.abs(errors)) < 0.01
    assert np.mean(np.abs(errors) > 0.1) < 0.03


def test_export_points_of_a_single_camera_lie_on_true_surfaces(with_a_single: Exported) -> None:
    """Its images belong to the rig, and its points to the model of the pair."""
    model, rig = read(with_a_single), with_a_single.session.rig
    assert [single.name for single in rig.singles] == ["cam2"]
    assert model.num_reg_images() == 3 * len(with_a_single.session.places)
    errors = depth_errors(with_a_single, 2)
    assert len(errors) > 200
    assert np.median(np.abs(errors)) < 0.02
    assert np.mean(np.abs(errors) > 0.1) < 0.1


def depth_errors(exported: Exported, *numbers: int) -> Float:
    """Relative errors (N,) of the depths of points that some cameras see, by their numbers in the rig."""
    simulator = walk_simulator(SECONDS)
    row_of = {int(stamp): row for row, stamp in enumerate(simulator.stamps_ns)}
    model = read(exported)
    errors = []
    for place in exported.session.places[::3]:
        for number in numbers:
            camera = exported.session.rig.cameras[number]
            depth = simulator.view(row_of[place.stamp_ns], number).depth
            image = model.find_image_with_name(image_name(NAME, camera.name, place.stamp_ns))
            cam_T_world = image.cam_from_world()
            for each in image.points2D:
                if each.has_point3D():
                    u, v = np.round(each.xy - 0.5).astype(int)
                    errors.append((cam_T_world * model.point3D(each.point3D_id).xyz)[2] / depth[v, u] - 1.0)
    return np.array(errors)


def test_export_images_are_lossless(exported: Exported) -> None:
    place, pair = exported.session.places[-1], exported.session.rig.pairs[1]
    images = exported.session.source.frameset_at(place.stamp_ns).images[1]
    for camera, image in zip((pair.left, pair.right), images, strict=True):
        path = exported.folder / "images" / image_name(NAME, camera.name, place.stamp_ns)
        np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), image)
    assert all((exported.folder / "images" / image.name).exists() for image in read(exported).images.values())


def test_alike_matches_as_colmap(exported: Exported) -> None:
    first, second = (image_name(NAME, "cam0", place.stamp_ns) for place in exported.session.places[:2])
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    matcher = pycolmap.FeatureMatcher.create(options, pycolmap.Device.cpu)
    file = pycolmap.Database.open(exported.database)
    keypoints, descriptors = [], []
    for image in (file.read_image_with_name(first), file.read_image_with_name(second)):
        rows = np.zeros((file.num_keypoints_for_image(image.image_id), 4), dtype=np.float32)
        rows[:, 2] = 1.0
        keypoints.append(pycolmap.keypoints_from_matrix(rows))
        descriptors.append(file.read_descriptors(image.image_id))
    file.close()
    expected = matcher.match(keypoints[0], descriptors[0], keypoints[1], descriptors[1])
    found = alike(*(np.asarray(each.data) for each in descriptors))
    assert len(found) > 50
    np.testing.assert_array_equal(found, expected)
    assert alike(np.zeros((0, 128), np.uint8), np.asarray(descriptors[0].data)).shape == (0, 2)


def test_export_refused_loop_closure_makes_no_points(exported: Exported, again: tuple[FeatureDatabase, Path]) -> None:
    database, folder = again
    places = exported.session.places
    names = [image_name(NAME, "cam0", place.stamp_ns) for place in (places[0], places[-1])]
    rows = np.column_stack([np.arange(100), np.arange(100)])
    database.add_matches(names[0], names[1], rows)
    closure = LoopClosure(places[0], places[-1], np.eye(4), np.eye(6), 100, ((0, 0),), False)
    refused = replace(exported.optimization, loops=[JudgedLoop(closure, "far from the solution", 1e3)])
    export(refused, [exported.session], database, folder, Config())
    assert (names[0], names[1]) not in database.verified_pairs()
    np.testing.assert_array_equal(database.all_matches(names[0], names[1]), rows)
    assert [path.name for path in (folder / "sparse").iterdir()] == ["0"]
    model, before = read_model(folder, 0), read(exported)
    assert model.num_points3D() == before.num_points3D()
    assert model.compute_num_observations() == before.compute_num_observations()


def test_export_used_loop_closure_verifies_matches_by_poses(
    exported: Exported, again: tuple[FeatureDatabase, Path]
) -> None:
    """The matches of two neighbours, and as many wrong ones."""
    database, folder = again
    places = exported.session.places[:2]
    names = [image_name(NAME, "cam0", place.stamp_ns) for place in (places[0], places[1])]
    right, all_rows = database.matches(names[0], names[1]), database.all_matches(names[0], names[1])
    assert 0.8 * len(all_rows) < len(right) <= len(all_rows)
    others = image_name(NAME, "cam2", places[1].stamp_ns)
    count = min(len(database.pixels(names[0])), len(database.pixels(others)))
    wrong = np.column_stack([np.arange(count), np.arange(count)[::-1]])
    database.add_matches(names[0], others, wrong)
    closure = LoopClosure(places[0], places[1], np.eye(4), np.eye(6), 100, ((0, 1),), False)
    used = replace(exported.optimization, loops=[JudgedLoop(closure, "", 1.0)])
    export(used, [exported.session], database, folder, Config())
    np.testing.assert_array_equal(database.matches(names[0], names[1]), right)
    assert len(database.matches(names[0], others)) < 0.2 * len(wrong)


def test_export_frames_are_models_the_largest_first(exported: Exported, again: tuple[FeatureDatabase, Path]) -> None:
    database, folder = again
    (folder / "sparse" / "7").mkdir(parents=True)
    session = exported.optimization.sessions[0]
    parted = np.where(np.arange(len(session.frame)) < exported.session.places[2].row, 0, 1)
    apart = replace(exported.optimization, sessions=[replace(session, frame=parted)])
    export(apart, [exported.session], database, folder, Config())
    assert sorted(path.name for path in (folder / "sparse").iterdir()) == ["0", "1"]
    first, second = (read_model(folder, number) for number in range(2))
    for model, places in ((first, exported.session.places[2:]), (second, exported.session.places[:2])):
        assert model.num_frames() == len(places)
        stamps = {int(Path(image.name).stem) for image in model.images.values()}
        assert stamps == {place.stamp_ns for place in places}
    assert not set(first.images) & set(second.images)
    assert min(first.num_points3D(), second.num_points3D()) > 0


def test_export_database_without_places_raises(exported: Exported, tmp_path: Path) -> None:
    path = tmp_path / "empty.db"
    with FeatureDatabase(path) as database, pytest.raises(OptimizationError, match=r"empty\.db: holds no image"):
        export(exported.optimization, [exported.session], database, tmp_path, Config())
