"""Construction of a rig from a recording's messages: intrinsics from ``camera_info``, extrinsics from ``tf_static``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from graphvio.arrays import Float
from graphvio.cameras import MODEL_NAMES, N_COEFFICIENTS
from graphvio.errors import RigError, SessionError
from graphvio.geometry import se3_inverse
from graphvio.rig import Camera, Imu, Rig, StereoPair, checked_views
from graphvio.sessions import cdr
from graphvio.sessions.messages import CAMERA_INFO, COMPRESSED, IMAGE, IMU, ROS_DISTORTIONS, TRANSFORMS, pose_of
from graphvio.sessions.topics import MessageReader, Topic, camera_of, is_mask, of_type, preference

_MODELS = {ROS_DISTORTIONS.get(model, model): model for model in MODEL_NAMES}
_SIDES = (("left", "right"), ("infra1", "infra2"), ("cam0", "cam1"), ("cam2", "cam3"))
_WORDS = tuple(side for sides in _SIDES for side in sides)


def rig_of_topics(messages: MessageReader, name: str) -> Rig | None:
    """Make the rig of all stereo pairs that have images, ``camera_info`` and extrinsics; None if there is no pair.

    The names of a pair's topics differ in one part only: ``left`` and ``right``, ``infra1`` and ``infra2``. Of several
    topics with one camera's images one is used (see `preference`), and of several topics with IMU samples the first by
    name. Without a transform to the right camera, the fourth column of its projection matrix gives the baseline. Body
    is the frame of the IMU, or that of the first left camera.

    Raises:
        RigError: if transforms are missing, or a camera is of an unknown kind.
        SessionError: if a message is damaged.
    """
    images = [each.name for each in of_type(messages.topics, IMAGE, COMPRESSED)]
    transforms = transforms_of(messages)
    imu = next(iter(of_type(messages.topics, IMU)), None)
    found = []
    for pair, (left, right) in stereo_topics(images).items():
        left_info, right_info = _info(messages, left), _info(messages, right)
        if left_info is not None and right_info is not None:
            found.append((pair, left, right, left_info, right_info))
    if not found:
        return None
    body = _first(messages, imu).header.frame_id if imu is not None else _frame(found[0][3], found[0][1])
    pairs = []
    for pair, left, right, left_info, right_info in found:
        left_frame = _frame(left_info, left)
        body_T_left = path_between(transforms, body, left_frame)
        if body_T_left is None:
            start = f"the IMU ({body})" if imu is not None else body
            raise RigError(f"{name}: no transform leads from {start} to {left_frame}; give a rig of your own")
        left_T_right = path_between(transforms, left_frame, _frame(right_info, right))
        if left_T_right is None or np.allclose(left_T_right, np.eye(4)):
            left_T_right = np.eye(4)
            left_T_right[0, 3] = -right_info.p[3] / right_info.p[0] if right_info.p[0] else 0.0
        left_camera = _camera(left, left_info, body_T_left)
        pairs.append(StereoPair(pair, left_camera, _camera(right, right_info, body_T_left @ left_T_right)))
    return checked_views(Rig(tuple(pairs), Imu() if imu is not None else None, name))


def stereo_topics(images: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return the stereo pairs among topics with images: name of the pair -> topics of its left and right camera.

    The names of the two topics differ in one part only. Of several topics of a camera, such as raw and compressed or
    raw and rectified, one is used: see `preference`.
    """
    names = sorted(name for name in images if not is_mask(name))
    made: dict[tuple[str, str], tuple[str, str]] = {}
    for name in sorted(names, key=preference):
        for left, right in _SIDES:
            parts = name.split("/")
            for k, part in enumerate(parts):
                other = "/".join([*parts[:k], part.replace(left, right), *parts[k + 1 :]])
                if left in part and other in names:
                    made.setdefault((camera_of(name, _WORDS), camera_of(other, _WORDS)), (name, other))
    found = sorted(made.items())
    short = [_without_side(left) for (left, _), _ in found]
    return {
        name if short.count(name) == 1 else "-".join(filter(None, left.split("/"))): topics
        for name, ((left, _), topics) in zip(short, found, strict=True)
    }


def _without_side(camera: str) -> str:
    """Return a pair's name: the name of its left camera without the side."""
    parts = [part for part in camera.split("/") if part]
    others = [part for part in parts if not any(side in part for side in _WORDS)]
    return "-".join(others) or "-".join(parts)


def info_topics(image_topic: str) -> list[str]:
    """Return the topics that may have the calibration for a topic with images, the nearest name first."""
    parts = image_topic.split("/")
    return ["/".join([*parts[:depth], "camera_info"]) for depth in range(len(parts) - 1, 0, -1)]


def _info(messages: MessageReader, image_topic: str) -> Any:
    """Return the ``CameraInfo`` for a topic with images, or None."""
    for name in info_topics(image_topic):
        topic = messages.topics.get(name)
        if topic is not None and topic.type_name == CAMERA_INFO and topic.places:
            return _first(messages, topic)
    return None


def _first(messages: MessageReader, topic: Topic) -> Any:
    """Return the first undamaged message of a topic."""
    for place in topic.places[:-1]:
        try:
            return cdr.decode(messages.read(place), topic.type_name, messages.path)
        except SessionError:  # the other messages have the same content
            continue
    return cdr.decode(messages.read(topic.places[-1]), topic.type_name, messages.path)


def _camera(topic: str, info: Any, body_T_cam: Float) -> Camera:
    if info.distortion_model not in _MODELS:
        raise RigError(f"{topic}: its camera_info has the distortion {info.distortion_model!r}, which is not known")
    model, distortion = _MODELS[info.distortion_model], np.asarray(info.d, dtype=np.float64)
    if np.any(distortion[N_COEFFICIENTS:]):
        raise RigError(
            f"{topic}: its camera_info has {len(distortion)} distortion coefficients; "
            f"at most {N_COEFFICIENTS} are known"
        )
    if model == "rational" and not np.any(distortion[5:]):
        model = "radial-tangential"
    k = np.asarray(info.k, dtype=np.float64).reshape(3, 3)
    return Camera(
        name=topic,
        model=model,
        size_px=(int(info.width), int(info.height)),
        intrinsics=np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]]),
        distortion=distortion[:N_COEFFICIENTS],
        body_T_cam=body_T_cam,
    )


def _frame(info: Any, topic: str) -> str:
    return str(info.header.frame_id) or topic


def transforms_of(messages: MessageReader) -> dict[tuple[str, str], Float]:
    """Return all static transforms of a recording, in the form of `transforms_in`."""
    made: dict[tuple[str, str], Float] = {}
    for topic in messages.topics.values():
        if topic.type_name != TRANSFORMS or not topic.name.endswith("tf_static"):
            continue
        for place in topic.places:
            made.update(transforms_in(cdr.decode(messages.read(place), TRANSFORMS, messages.path)))
    return made


def transforms_in(message: Any) -> dict[tuple[str, str], Float]:
    """Return the transforms of a ``TFMessage`` and their inverses: (parent, child) -> ``parent_T_child`` (4, 4)."""
    made: dict[tuple[str, str], Float] = {}
    for each in message.transforms:
        pose = pose_of(each)
        parent, child = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
        made[parent, child], made[child, parent] = pose, se3_inverse(pose)
    return made


def path_between(transforms: dict[tuple[str, str], Float], start: str, end: str) -> Float | None:
    """Return ``start_T_end`` (4, 4) along transforms as of `transforms_in`, or None if no path leads there."""
    start, end = start.lstrip("/"), end.lstrip("/")
    reached = {start: np.eye(4)}
    waiting = [start]
    while waiting:
        at = waiting.pop(0)
        for parent, child in transforms:
            if parent == at and child not in reached:
                reached[child] = reached[at] @ transforms[parent, child]
                waiting.append(child)
    return reached.get(end)
