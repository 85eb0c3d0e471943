"""Logs a run to rerun.

| entity | contents |
|---|---|
| ``world/rig`` | pose of body in nav |
| ``world/rig/<camera>`` | pose and pinhole model; for left cameras also ``image`` and ``corners`` below it |
| ``world/rig/uncertainty`` | ellipsoid of three standard deviations of the position |
| ``world/trajectory/<epoch>/<n>`` | the n-th segment of the path, coloured by status |
| ``rates/<axis>/<source>`` | angular rate of body from gyro, vision and their fusion, rad/s (figure 5 of the paper) |
| ``biases/gyro``, ``biases/accel`` | biases of gyro, rad/s, and accelerometer, m/s^2 |
| ``points/<pair>/candidates``, ``inliers`` | number of points |
| ``residuals/<pair>/joint``, ``own`` | rms reprojection error, px, under the selected motion and the pair's own |
| ``timing/<stage>`` | processing time of a stage, milliseconds |
| ``calibration/<group>/<curve>`` | difference from the rig file, with one standard deviation below and above |
| ``events`` | changes of status, rejections by gates, resets, faults |

The timeline ``time`` is relative to the first stamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr

from graphvio.arrays import Float
from graphvio.cameras import central_scale
from graphvio.geometry import quat_wxyz_from_rotation
from graphvio.measurements.estimate import Estimate, Status
from graphvio.measurements.events import Event
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Rig
from graphvio.self_calibration.curves import Curve, curves_of, values_of
from graphvio.self_calibration.estimate import CalibrationEstimate
from graphvio.trajectory import Trajectory
from graphvio.viewer.layout import AXES, RATE_COLOURS, STATUS_COLOURS, TIMELINE, as_entity, blueprint
from graphvio.viewer.processes import WINDOW_URL, WebHost, WebOptions, open_window

_MAX_SEGMENT_POSES = 100
_SIGMAS = 3.0
_JPEG_QUALITY = 80
_CURVES_NS = 500_000_000
_FLUSH_S = 30.0
_FRUSTUM_M = 0.25
_INLIER, _OUTLIER = (60, 220, 90), (235, 60, 50)
_PAIR_CURVES = {
    "points/{}/candidates": "points",
    "points/{}/inliers": "inliers",
    "residuals/{}/joint": "rms_px",
    "residuals/{}/own": "own_rms_px",
}
_XYZ_COLOURS = [(220, 70, 60), (60, 170, 75), (70, 110, 230)]


class Recording:
    """A stream to rerun's window, to browsers, to a file or to several of these; methods are called by one thread.

    Raises:
        GraphvioError: if browsers cannot be served.
        OSError, RuntimeError: raised by rerun, if the file or the window cannot be opened.
    """

    def __init__(self, rig: Rig, *, spawn: bool, save: Path | None, web: WebOptions | None = None) -> None:
        self._rig = rig
        self._is_saved = save is not None
        self._stream = rr.RecordingStream("graphvio", recording_id=None, make_default=False)
        layout = blueprint(rig)
        sinks: list[Any] = []
        if save is not None:
            sinks.append(rr.FileSink(str(save)))
        if spawn:
            open_window()
            sinks.append(rr.GrpcSink(WINDOW_URL))
        self._web = None if web is None else WebHost(web)
        if web is not None:
            sinks.append(rr.GrpcSink(web.data_url))
        self._stream.set_sinks(*sinks, default_blueprint=layout)
        self._start_ns: int | None = None
        self._unsent: list[Estimate] = []
        self._status: Status | None = None
        self._calibration_curves: list[Curve] = []
        self._segment: list[tuple[int, Float, Status]] = []
        self._segment_number = 0
        self._epoch = 0
        self._log_static()

    def close(self) -> None:
        """Log pending curves, flush and disconnect."""
        self._send_curves()
        try:
            self._stream.flush(timeout_sec=_FLUSH_S)
        except RuntimeError as error:
            if self._is_saved and "gRPC" not in str(error):  # a gRPC error may come from a window that was closed
                raise
        finally:
            self._stream.disconnect()
            if self._web is not None:
                self._web.close()

    def add_estimates(self, estimates: Sequence[Estimate]) -> None:
        """Log the poses, covariances, curves and changes of status of estimates."""
        if not estimates:
            return
        if self._start_ns is None:
            self._start_ns = estimates[0].stamp_ns
        posed = [e for e in estimates if e.nav_T_body is not None]
        self._send_poses(posed)
        self._extend_path(posed)
        self._unsent += estimates
        if self._unsent[-1].stamp_ns - self._unsent[0].stamp_ns >= _CURVES_NS:
            self._send_curves()
        for estimate in estimates:
            if estimate.status is not self._status:
                self._at(estimate.stamp_ns)
                self._log_text(str(estimate.status), "status", STATUS_COLOURS[estimate.status])
                self._status = estimate.status

    def add_event(self, event: Event) -> None:
        """Log an event at its stamp."""
        self._at(event.stamp_ns)
        self._log_text(event.detail, event.kind, (200, 200, 200))

    def add_calibration(self, stamp_ns: int, estimate: CalibrationEstimate) -> None:
        """Log a calibration that came into force at a stamp."""
        if not self._calibration_curves:
            self._calibration_curves = curves_of(estimate.file_rig)
            for curve in self._calibration_curves:
                lines = rr.SeriesLines(names=[curve.name or curve.group, "- sigma", "+ sigma"], widths=[2.0, 0.5, 0.5])
                self._stream.log(_entity_of(curve), lines, static=True)
        self._at(stamp_ns)
        for curve, value, sigma in zip(
            self._calibration_curves, *values_of(self._calibration_curves, estimate), strict=True
        ):
            self._stream.log(_entity_of(curve), rr.Scalars([value, value - sigma, value + sigma]))

    def add_images(self, frameset: FrameSet, estimate: Estimate) -> None:
        """Log the left images of a frameset with their corners, inliers in green, others in red."""
        self._at(frameset.stamp_ns)
        for index, images in frameset.images.items():
            camera = f"world/rig/{self._rig.groups[index].left.name}"
            done, jpeg = cv2.imencode(".jpg", images[0], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            if done:
                image = rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")
                self._stream.log(f"{camera}/image", image)
            report = estimate.pairs.get(index)
            if report is not None:
                colours = np.where(np.asarray(report.is_inlier)[:, None], _INLIER, _OUTLIER).astype(np.uint8)
                corners = rr.Points2D(report.pixels, colors=colours, radii=rr.Radius.ui_points(2.5))
                self._stream.log(f"{camera}/corners", corners)

    def add_path(self, name: str, trajectory: Trajectory, colour: tuple[int, int, int]) -> None:
        """Log another trajectory, which is visible at all times of the timeline."""
        strip = rr.LineStrips3D([trajectory.positions], colors=[colour], radii=rr.Radius.ui_points(1.0))
        self._stream.log(f"world/{name}", strip, static=True)

    def _log_static(self) -> None:
        log = self._stream.log
        log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for camera in self._rig.cameras:
            _, _, cx, cy = camera.intrinsics
            fx, fy = camera.intrinsics[:2] * central_scale(camera.model_number, camera.distortion)
            pose = rr.Transform3D(translation=camera.body_T_cam[:3, 3], mat3x3=camera.body_T_cam[:3, :3])
            pinhole = rr.Pinhole(
                image_from_camera=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
                resolution=list(camera.size_px),
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=_FRUSTUM_M,
            )
            log(f"world/rig/{camera.name}", pose, pinhole, static=True)
        for axis in AXES:
            for source, colour in RATE_COLOURS.items():
                log(f"rates/{axis}/{source}", rr.SeriesLines(names=source, colors=[colour]), static=True)
        for sensor in ("gyro", "accel"):
            log(f"biases/{sensor}", rr.SeriesLines(names=[*AXES], colors=_XYZ_COLOURS), static=True)

    def _send_poses(self, posed: Sequence[Estimate]) -> None:
        poses = [np.asarray(e.nav_T_body) for e in posed]
        if not poses:
            return
        quats = np.array([_quat_xyzw(pose[:3, :3]) for pose in poses])
        translations = np.array([pose[:3, 3] for pose in poses])
        self._send("world/rig", posed, rr.Transform3D.columns(translation=translations, quaternion=quats))
        with_covariance = [e for e in posed if e.covariance is not None]
        if with_covariance:
            axes = [ellipsoid(np.asarray(e.covariance)[3:, 3:]) for e in with_covariance]
            spheres = rr.Ellipsoids3D.columns(
                half_sizes=np.array([half for half, _ in axes]),
                quaternions=np.array([quat for _, quat in axes]),
            )
            self._send("world/rig/uncertainty", with_covariance, spheres)

    def _send_curves(self) -> None:
        """Log the curves of all estimates that have not been logged, one message per curve."""
        estimates, self._unsent = self._unsent, []
        for source in RATE_COLOURS:
            for k, axis in enumerate(AXES):
                rates = [e.rates[source][k] if source in e.rates else None for e in estimates]
                self._send_scalars(f"rates/{axis}/{source}", estimates, rates)
        self._send_scalars("biases/gyro", estimates, [e.gyro_bias for e in estimates])
        self._send_scalars("biases/accel", estimates, [e.accel_bias for e in estimates])
        for stage in sorted({stage for e in estimates for stage in e.stage_ms}):
            self._send_scalars(f"timing/{stage}", estimates, [e.stage_ms.get(stage) for e in estimates])
        for index in sorted({index for e in estimates for index in e.pairs}):
            name = self._rig.groups[index].name
            for entity, figure in _PAIR_CURVES.items():
                reported = [getattr(e.pairs[index], figure) if index in e.pairs else None for e in estimates]
                self._send_scalars(entity.format(name), estimates, reported)

    def _send_scalars(self, entity: str, estimates: Sequence[Estimate], all_values: Sequence[Any]) -> None:
        """Log one value per estimate, a number or a vector (3,), where it is not None."""
        known = [(e, v) for e, v in zip(estimates, all_values, strict=True) if v is not None]
        if not known:
            return
        values = np.array([v for _, v in known], dtype=np.float64)
        columns = rr.Scalars.columns(scalars=values.ravel())
        if values.ndim > 1:
            columns = columns.partition(np.full(len(values), values.shape[1]))
        self._send(entity, [e for e, _ in known], columns)

    def _send(self, entity: str, estimates: Sequence[Estimate], columns: Any) -> None:
        since = np.array([e.stamp_ns - (self._start_ns or 0) for e in estimates], dtype="timedelta64[ns]")
        self._stream.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=since)], columns)

    def _extend_path(self, posed: Sequence[Estimate]) -> None:
        """Extend the path and log it; it is split into segments of at most 100 poses, so that costs do not grow."""
        for estimate in posed:
            if estimate.epoch != self._epoch:
                self._log_segment()
                self._segment, self._epoch, self._segment_number = [], estimate.epoch, 0
            self._segment.append((estimate.stamp_ns, np.asarray(estimate.nav_T_body)[:3, 3], estimate.status))
            if len(self._segment) > _MAX_SEGMENT_POSES:
                self._log_segment()
                self._segment, self._segment_number = self._segment[-1:], self._segment_number + 1
        self._log_segment()

    def _log_segment(self) -> None:
        """Log the whole newest segment at the time of its last pose, in place of its shorter version."""
        strips: list[list[Float]] = []
        colours: list[tuple[int, int, int]] = []
        for (_, before, _), (_, position, status) in zip(self._segment, self._segment[1:], strict=False):
            if not colours or colours[-1] != STATUS_COLOURS[status]:
                strips.append([before])
                colours.append(STATUS_COLOURS[status])
            strips[-1].append(position)
        if strips:
            self._at(self._segment[-1][0])
            entity = f"world/trajectory/{self._epoch}/{self._segment_number}"
            self._stream.log(entity, rr.LineStrips3D(strips, colors=colours, radii=rr.Radius.ui_points(1.5)))

    def _log_text(self, text: str, kind: str, colour: tuple[int, int, int]) -> None:
        self._stream.log("events", rr.TextLog(f"{kind}: {text}", level="INFO", color=[*colour, 255]))

    def _at(self, stamp_ns: int) -> None:
        if self._start_ns is None:
            self._start_ns = stamp_ns
        self._stream.set_time(TIMELINE, duration=np.timedelta64(int(stamp_ns) - self._start_ns, "ns"))


def ellipsoid(covariance: Float) -> tuple[Float, Float]:
    """Compute a position's ellipsoid of three standard deviations: half axes (3,) and their quaternion ``x y z w``."""
    variances, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] = -axes[:, 0]
    return _SIGMAS * np.sqrt(np.maximum(variances, 0.0)), _quat_xyzw(axes)


def _entity_of(curve: Curve) -> str:
    return f"calibration/{as_entity(curve.group)}/{as_entity(curve.name or 'value')}"


def _quat_xyzw(rotation: Float) -> Float:
    w, x, y, z = quat_wxyz_from_rotation(np.ascontiguousarray(rotation))
    return np.array([x, y, z, w])
