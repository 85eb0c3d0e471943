"""A COLMAP database of places: cameras and rig, images, features and matches.

The origin of pixel coordinates is the image's corner in COLMAP and the centre of its first pixel in graphvio: half a
pixel is added when writing and subtracted when reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Float, Int
from graphvio.errors import OptimizationError
from graphvio.optimization.loops.colmap_library import CENTRE_PX, colmap
from graphvio.rig import Camera, Rig

_COLMAP_MODELS = {
    "radial-tangential": "FULL_OPENCV",
    "equidistant": "OPENCV_FISHEYE",
    "rational": "FULL_OPENCV",
    "extended-unified": "EUCM",
}
_COLMAP_COEFFICIENTS = {"OPENCV": 4, "FULL_OPENCV": 8, "OPENCV_FISHEYE": 4, "EUCM": 2}


def image_name(session: str, camera: str, stamp_ns: int) -> str:
    """Return the name of an image in databases and reconstructions, and of its file in their image folder."""
    return f"{session}/{camera}/{stamp_ns}.png"


def colmap_model(camera: Camera) -> str:
    """Return the name of COLMAP's model for a camera's lens.

    Raises:
        OptimizationError: if COLMAP has no model for it.
    """
    if camera.model == "radial-tangential" and not camera.distortion[4]:
        return "OPENCV"
    if camera.model in _COLMAP_MODELS:
        return _COLMAP_MODELS[camera.model]
    raise OptimizationError(
        f"camera {camera.name}: COLMAP has no model for its {camera.model} lens; for loop closure and maps, "
        f"calibrate it with one of {', '.join(_COLMAP_MODELS)}; sessions can be optimised with --no-loops"
    )


def colmap_camera(camera: Camera, number: int) -> Any:
    """Return a camera of the rig as a COLMAP camera.

    Raises:
        OptimizationError: if COLMAP has no model for its lens.
        MissingExtraError: if the extra ``maps`` is not installed.
    """
    fx, fy, cx, cy = (float(value) for value in camera.intrinsics)
    centre = [cx + CENTRE_PX, cy + CENTRE_PX]
    model = colmap_model(camera)
    lens = camera.distortion.tolist()[: _COLMAP_COEFFICIENTS[model]]
    width, height = camera.size_px
    return colmap().Camera(
        model=model, width=width, height=height, params=[fx, fy, *centre, *lens], camera_id=number,
        has_prior_focal_length=True,
    )  # fmt: skip


class FeatureDatabase:
    """The database of one or several sessions; a context manager that closes it.

    Raises:
        OptimizationError: if it cannot be opened.
        MissingExtraError: if the extra ``maps`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        self._colmap = colmap()
        self.path = path
        try:
            self._file = self._colmap.Database.open(path)
        except (RuntimeError, ValueError) as error:
            raise OptimizationError(f"{path}: cannot be opened as a COLMAP database ({error})") from None
        self._ids: dict[str, int] = {image.name: image.image_id for image in self._file.read_all_images()}

    def __enter__(self) -> FeatureDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def names(self) -> frozenset[str]:
        """Names of all images."""
        return frozenset(self._ids)

    def frame_id(self, name: str) -> int:
        """Return COLMAP's number of an image's frame."""
        return int(self._file.read_image(self._ids[name]).frame_id)

    def transaction(self) -> AbstractContextManager[Any]:
        """Return a context manager whose writes succeed together or not at all."""
        return self._colmap.DatabaseTransaction(self._file)  # type: ignore[no-any-return]

    def rig_of(self, session: str, rig: Rig) -> tuple[int, dict[str, int]] | None:
        """Return the numbers of a session's rig and cameras, as `add_rig` does; None if the session has no images."""
        taken = next((number for name, number in self._ids.items() if name.rsplit("/", 2)[0] == session), None)
        if taken is None:
            return None
        sensor = self._colmap.sensor_t(self._colmap.SensorType.CAMERA, self._file.read_image(taken).camera_id)
        found = self._file.read_rig_with_sensor(sensor)
        others = sorted(each.id for each in found.non_ref_sensors)  # ids are in the order of writing
        names = [camera.name for camera in rig.cameras]
        return found.rig_id, dict(zip(names, [found.ref_sensor_id.id, *others], strict=True))

    def add_rig(self, rig: Rig) -> tuple[int, dict[str, int]]:
        """Add a rig, with its first camera as COLMAP's reference sensor; returns its number, and camera -> number."""
        numbers = {camera.name: self._file.write_camera(colmap_camera(camera, 0)) for camera in rig.cameras}
        return self._file.write_rig(self._rig(rig, numbers)), numbers

    def move_cameras(self, session: str, rig: Rig) -> None:
        """Update the extrinsics of a session's cameras, if it has images, to those of a rig."""
        known = self.rig_of(session, rig)
        if known is not None:
            made = self._rig(rig, known[1])
            made.rig_id = known[0]
            self._file.update_rig(made)

    def _rig(self, rig: Rig, numbers: Mapping[str, int]) -> Any:
        library = self._colmap
        made = library.Rig()
        for camera in rig.cameras:
            sensor = library.sensor_t(library.SensorType.CAMERA, numbers[camera.name])
            if camera is rig.cameras[0]:
                made.add_ref_sensor(sensor)
            else:
                made.add_sensor(sensor, rigid(camera.cam_T_body @ rig.cameras[0].body_T_cam))
        return made

    def add_place(self, rig_id: int, images: Mapping[int, str]) -> None:
        """Add the images of one instant, given as camera number -> name."""
        library = self._colmap
        frame = library.Frame(rig_id=rig_id)
        made = []
        for camera, name in images.items():
            image = library.Image(name=name, camera_id=camera)
            image.image_id = self._ids[name] = self._file.write_image(image)
            frame.add_data_id(image.data_id)
            made.append(image)
        frame.frame_id = self._file.write_frame(frame)
        for image in made:
            image.frame_id = frame.frame_id
            self._file.update_image(image)

    def add_features(self, name: str, pixels: Float, descriptors: AnyArray | None = None) -> None:
        """Add features (K, 2) of an image in pixels, and their descriptors (K, 128), uint8."""
        number = self._ids[name]
        self._file.write_keypoints(number, (pixels + CENTRE_PX).astype(np.float32).reshape(-1, 2))
        if descriptors is not None:
            kind = self._colmap.FeatureExtractorType.SIFT
            self._file.write_descriptors(number, self._colmap.FeatureDescriptors(kind, descriptors))

    def pixels(self, name: str) -> Float:
        """Return the features (K, 2) of an image in pixels."""
        return np.asarray(self._file.read_keypoints(self._ids[name])[:, :2], dtype=np.float64) - CENTRE_PX

    def descriptors(self, name: str) -> AnyArray:
        """Return the descriptors (K, 128), uint8, of an image's features."""
        return np.asarray(self._file.read_descriptors(self._ids[name]).data, dtype=np.uint8).reshape(-1, 128)

    def add_matches(self, first: str, second: str, matches: Int, geometry: Any = None) -> None:
        """Add matches (M, 2) of two images and the geometry that verifies them; with None, all count as verified."""
        one, other = self._ids[first], self._ids[second]
        rows = np.ascontiguousarray(matches, dtype=np.uint32).reshape(-1, 2)
        self._file.write_matches(one, other, rows)
        if geometry is None:
            library = self._colmap
            geometry = library.TwoViewGeometry()
            geometry.config = library.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = rows
        self._file.write_two_view_geometry(one, other, geometry)

    def matches(self, first: str, second: str) -> Int:
        """Return the verified matches (M, 2) of two images."""
        found = self._file.read_two_view_geometry(self._ids[first], self._ids[second])
        return np.asarray(found.inlier_matches, dtype=np.int64).reshape(-1, 2)

    def all_matches(self, first: str, second: str) -> Int:
        """Return all matches (M, 2) of two images, verified or not."""
        found = self._file.read_matches(self._ids[first], self._ids[second])
        return np.asarray(found, dtype=np.int64).reshape(-1, 2)

    def has_matches(self, first: str, second: str) -> bool:
        """Whether two images were matched."""
        return bool(self._file.exists_matches(self._ids[first], self._ids[second]))

    def verified_pairs(self) -> list[tuple[str, str]]:
        """Return the names of all pairs of images with verified matches."""
        names = {number: name for name, number in self._ids.items()}
        pairs, _ = self._file.read_two_view_geometry_num_inliers()
        found = [self._colmap.pair_id_to_image_pair(pair) for pair in pairs]
        return [(names[first], names[second]) for first, second in found]

    def verify(self, first: str, second: str, geometry: Any) -> None:
        """Replace the two-view geometry that verifies the matches of two images; with None, no match is verified."""
        one, other = self._ids[first], self._ids[second]
        if self._file.exists_two_view_geometry(one, other):
            self._file.delete_two_view_geometry(one, other)
        if geometry is not None:
            self._file.write_two_view_geometry(one, other, geometry)

    def model(self, rigs: Mapping[int, Float]) -> Any:
        """Return a reconstruction of frames without points; ``rigs`` gives their poses.

        Args:
            rigs: COLMAP's number of a frame -> ``cam_T_world`` (4, 4) of the rig's reference camera.
        """
        file, made = self._file, self._colmap.Reconstruction()
        frames = [frame for frame in file.read_all_frames() if frame.frame_id in rigs]
        of_frames = {frame.rig_id for frame in frames}
        used = [rig for rig in file.read_all_rigs() if rig.rig_id in of_frames]
        cameras = {sensor.id for rig in used for sensor in rig.sensor_ids()}
        for camera in file.read_all_cameras():
            if camera.camera_id in cameras:
                made.add_camera(camera)
        for rig in used:
            made.add_rig(rig)
        for frame in frames:
            frame.rig_from_world = rigid(rigs[frame.frame_id])
            made.add_frame(frame)
        for image in file.read_all_images():
            if image.frame_id in rigs:
                made.add_image(image)
        for frame in frames:
            made.register_frame(frame.frame_id)
        return made


def rigid(a_T_b: Float) -> Any:
    """Return a transform (4, 4) as COLMAP's type."""
    return colmap().Rigid3d(np.ascontiguousarray(a_T_b[:3]))
