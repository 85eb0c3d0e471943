"""Conversion between graphvio's types and messages, lossless for all fields that the messages have."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphvio.arrays import AnyArray, Image
from graphvio.errors import ServiceError
from graphvio.measurements.estimate import Estimate, Prediction, Status
from graphvio.measurements.events import Event
from graphvio.measurements.motion import Quality
from graphvio.rig import Rig, as_written
from graphvio.rig_files import native
from graphvio.slam.keyframe import CorrectionResult, Keyframe, Landmarks
from graphvio.slam.service import messages
from graphvio.slam.service.arrays import byte_rows, floats, maybe_floats, packed, whole_numbers

_STATUS_OF = {getattr(messages, f"TRACKING_STATUS_{each.name}"): each for each in Status}
_NUMBER_OF_STATUS = {status: number for number, status in _STATUS_OF.items()}
_QUALITY_OF = {getattr(messages, f"VISION_QUALITY_{each.name}"): each for each in Quality}
_NUMBER_OF_QUALITY = {quality: number for number, quality in _QUALITY_OF.items()}
_INT64 = 2**63

Value = float | int | str | None


@functools.lru_cache(maxsize=4)  # many keyframes have the same rig
def rig_text(rig: Rig) -> str:
    """Return the text of a ``rig.yaml`` without masks, which are files on the server's machine."""
    bare = rig.with_cameras(lambda camera: as_written(replace(camera, mask=None), camera.body_T_cam))
    return native.to_text(bare, Path("/"))


@functools.lru_cache(maxsize=4)
def rig_of(text: str, origin: str) -> Rig:
    """Parse the rig that a server sent; equal texts give the same object.

    Raises:
        RigError: If this version of graphvio cannot read it.
    """
    return native.parse(text, Path(origin))


def estimate_message(estimate: Estimate) -> Any:
    """Return the proto's ``Estimate``."""
    return messages.Estimate(
        stamp_ns=estimate.stamp_ns,
        status=_NUMBER_OF_STATUS[estimate.status],
        epoch=estimate.epoch,
        odom_T_body=packed(estimate.nav_T_body),
        covariance=packed(estimate.covariance),
        velocity_odom=packed(estimate.velocity_nav),
        velocity_covariance=packed(estimate.velocity_covariance),
        gyro_bias=packed(estimate.gyro_bias),
        gyro_bias_covariance=packed(estimate.gyro_bias_covariance),
        accel_bias=packed(estimate.accel_bias),
        accel_bias_covariance=packed(estimate.accel_bias_covariance),
        gravity_odom=packed(estimate.gravity_nav),
        gravity_covariance=packed(estimate.gravity_covariance),
        tilt_covariance=packed(estimate.tilt_covariance),
        time_offset_s=estimate.time_offset_s,
        time_offset_sigma_s=estimate.time_offset_sigma_s,
        vision=_NUMBER_OF_QUALITY[estimate.vision],
        vision_reason=estimate.vision_reason,
        is_stationary=bool(estimate.is_stationary),
    )


def estimate_of(message: Any) -> Estimate:
    """Return the estimate; the odometry's diagnostics are not in the message, and empty.

    Raises:
        ServiceError: If the message is malformed, as in all functions below that convert a message.
    """
    return Estimate(
        stamp_ns=message.stamp_ns,
        status=_known(_STATUS_OF, message.status, "estimate: status"),
        nav_T_body=maybe_floats(message.odom_T_body, (4, 4), "estimate: odom_T_body"),
        covariance=maybe_floats(message.covariance, (6, 6), "estimate: covariance"),
        epoch=message.epoch,
        velocity_nav=maybe_floats(message.velocity_odom, (3,), "estimate: velocity_odom"),
        gyro_bias=maybe_floats(message.gyro_bias, (3,), "estimate: gyro_bias"),
        accel_bias=maybe_floats(message.accel_bias, (3,), "estimate: accel_bias"),
        velocity_covariance=maybe_floats(message.velocity_covariance, (3, 3), "estimate: velocity_covariance"),
        gyro_bias_covariance=maybe_floats(message.gyro_bias_covariance, (3, 3), "estimate: gyro_bias_covariance"),
        accel_bias_covariance=maybe_floats(message.accel_bias_covariance, (3, 3), "estimate: accel_bias_covariance"),
        gravity_nav=maybe_floats(message.gravity_odom, (3,), "estimate: gravity_odom"),
        gravity_covariance=maybe_floats(message.gravity_covariance, (3, 3), "estimate: gravity_covariance"),
        tilt_covariance=maybe_floats(message.tilt_covariance, (2, 2), "estimate: tilt_covariance"),
        time_offset_s=_maybe(message, "time_offset_s"),
        time_offset_sigma_s=_maybe(message, "time_offset_sigma_s"),
        vision=_known(_QUALITY_OF, message.vision, "estimate: vision"),
        vision_reason=message.vision_reason,
        is_stationary=message.is_stationary,
    )


def prediction_message(prediction: Prediction) -> Any:
    """Return the proto's ``Prediction``."""
    return messages.Prediction(
        stamp_ns=prediction.stamp_ns,
        epoch=prediction.epoch,
        odom_T_body=packed(prediction.nav_T_body),
        velocity_odom=packed(prediction.velocity_nav),
        angular_velocity=packed(prediction.angular_velocity),
    )


def prediction_of(message: Any) -> Prediction:
    """Return the prediction."""
    return Prediction(
        stamp_ns=message.stamp_ns,
        nav_T_body=floats(message.odom_T_body, (4, 4), "prediction: odom_T_body"),
        velocity_nav=floats(message.velocity_odom, (3,), "prediction: velocity_odom"),
        angular_velocity=floats(message.angular_velocity, (3,), "prediction: angular_velocity"),
        epoch=message.epoch,
    )


def event_message(event: Event, missed: int) -> Any:
    """Return the proto's ``EventUpdate``."""
    return messages.EventUpdate(stamp_ns=event.stamp_ns, kind=event.kind, detail=event.detail, missed=missed)


def keyframe_message(keyframe: Keyframe, with_images: bool, with_descriptors: bool) -> Any:
    """Return the proto's ``Keyframe``."""
    message = messages.Keyframe(
        id=keyframe.id,
        epoch=keyframe.epoch,
        stamp_ns=keyframe.stamp_ns,
        status=_NUMBER_OF_STATUS[keyframe.status],
        odom_T_body=packed(keyframe.odom_T_body),
        covariance=packed(keyframe.covariance),
        previous_id=keyframe.previous_id,
        previous_T_body=packed(keyframe.previous_T_body),
        relative_covariance=packed(keyframe.relative_covariance),
        landmarks=_landmarks_message(keyframe.landmarks, with_descriptors),
        calibrated_rig_yaml="" if keyframe.calibrated_rig is None else rig_text(keyframe.calibrated_rig),
    )
    for pair, (left, *right) in sorted(keyframe.images.items()) if with_images else ():
        message.images.add(pair=pair, left=_image_message(left), right=_image_message(right[0]) if right else None)
    return message


def keyframe_of(message: Any) -> Keyframe:
    """Return the keyframe."""
    where = f"keyframe {message.id}"
    return Keyframe(
        id=message.id,
        epoch=message.epoch,
        stamp_ns=message.stamp_ns,
        status=_known(_STATUS_OF, message.status, f"{where}: status"),
        odom_T_body=floats(message.odom_T_body, (4, 4), f"{where}: odom_T_body"),
        covariance=floats(message.covariance, (6, 6), f"{where}: covariance"),
        previous_id=_maybe(message, "previous_id"),
        previous_T_body=maybe_floats(message.previous_T_body, (4, 4), f"{where}: previous_T_body"),
        relative_covariance=maybe_floats(message.relative_covariance, (6, 6), f"{where}: relative_covariance"),
        landmarks=_landmarks_of(message.landmarks, where),
        images={each.pair: _images_of(each, where) for each in message.images},
        calibrated_rig=rig_of(message.calibrated_rig_yaml, "keyframe") if message.calibrated_rig_yaml else None,
    )


def _landmarks_message(landmarks: Landmarks, with_descriptors: bool) -> Any:
    descriptors = np.asarray(landmarks.descriptors, dtype=np.uint8)
    return messages.Landmarks(
        pair=np.asarray(landmarks.pair, dtype=np.int64).tolist(),
        track_id=np.asarray(landmarks.track_id, dtype=np.int64).tolist(),
        points_body=packed(landmarks.points_body),
        covariances=packed(landmarks.covariances),
        left_px=packed(landmarks.left_px),
        right_px=packed(landmarks.right_px),
        descriptor_size=descriptors.shape[1] if with_descriptors else 0,
        descriptors=descriptors.tobytes() if with_descriptors else b"",
    )


def _landmarks_of(message: Any, where: str) -> Landmarks:
    count = len(message.pair)
    return Landmarks(
        pair=whole_numbers(message.pair, f"{where}: pair", count),
        track_id=whole_numbers(message.track_id, f"{where}: track_id", count),
        points_body=floats(message.points_body, (count, 3), f"{where}: points_body"),
        covariances=floats(message.covariances, (count, 3, 3), f"{where}: covariances"),
        left_px=floats(message.left_px, (count, 2), f"{where}: left_px"),
        right_px=floats(message.right_px, (count, 2), f"{where}: right_px"),
        descriptors=byte_rows(message.descriptors, (count, message.descriptor_size), f"{where}: descriptors"),
    )


def _image_message(image: Image) -> Any:
    height, width = image.shape
    return messages.Image(width=width, height=height, pixels=np.ascontiguousarray(image).tobytes())


def _images_of(message: Any, where: str) -> tuple[AnyArray, ...]:
    sides = (message.left, message.right) if message.HasField("right") else (message.left,)
    return tuple(byte_rows(side.pixels, (side.height, side.width), f"{where}: image") for side in sides)


def result_message(result: CorrectionResult) -> Any:
    """Return the proto's ``CorrectResponse``."""
    return messages.CorrectResponse(
        accepted=bool(result.accepted),
        reason=result.reason,
        statistic=result.statistic,
        threshold=result.threshold,
        map_T_odom=packed(result.map_T_odom),
    )


def result_of(message: Any) -> CorrectionResult:
    """Return the outcome of a correction."""
    return CorrectionResult(
        accepted=message.accepted,
        reason=message.reason,
        statistic=_maybe(message, "statistic"),
        threshold=message.threshold,
        map_T_odom=maybe_floats(message.map_T_odom, (4, 4), "correction: map_T_odom"),
    )


def status_message(status: Mapping[str, Value]) -> Any:
    """Return the proto's ``StatusReport``."""
    report = messages.StatusReport()
    for name, value in status.items():
        _set_value(report.values[name], value)
    return report


def status_of(message: Any) -> dict[str, Value]:
    """Return the figures by name, in alphabetical order."""
    values = ((name, message.values[name]) for name in sorted(message.values))
    return {name: _maybe(value, value.WhichOneof("value") or "number") for name, value in values}


def _set_value(message: Any, value: Any) -> None:
    if value is None:
        return
    if isinstance(value, str):
        message.text = value
        return
    try:
        whole = operator.index(value)  # also numpy's integers
    except TypeError:
        message.number = float(value)
        return
    if -_INT64 <= whole < _INT64:
        message.count = whole
    else:
        message.number = float(whole)


def _maybe(message: Any, name: str) -> Any:
    return getattr(message, name) if message.HasField(name) else None


def _known(table: Mapping[int, Any], number: int, what: str) -> Any:
    if number not in table:
        raise ServiceError(f"{what} is {number}, which this version does not know; update graphvio on both sides")
    return table[number]
