"""Landmarks that move along with the camera that sees them first, while a window is adjusted.

A landmark is ``[a, b, w]``, the homogeneous point ``[a, b, 1, w]`` of a frame of its own. If this frame is that of the
camera that sees it first, and steps change its direction and distance there, all distances and baselines can grow by
the same factor without a change of any view. If the frame were fixed, such a step would change the views by the square
of its size, and the scale could be found in steps of a few percent only.
"""

from graphvio.arrays import Float
from graphvio.geometry import se3_compose
from graphvio.kernels import kernel, put
from graphvio.self_calibration.observation import MIN_DEPTH_RATIO

_MAX_NEARER = 0.5  # largest relative step to a larger inverse depth that is taken as a step of the depth


@kernel
def move_landmark(
    frame: Float, landmark: Float, inverse: Float, gradient: Float, pose: Float, moved_pose: Float, body_T_cam: Float,
    step: Float, max_farther: float, work: Float, moved: Float,
) -> None:  # fmt: skip
    """Fill in a landmark (3,) after a step, and its frame: the camera's, or as it was where it is behind the camera.

    Args:
        frame: (4, 4) frame of the landmark in odom; also output.
        landmark: (3,) before.
        inverse: (3, 3) inverse of its normal matrix.
        gradient: (3,) gradient of the cost with respect to it, after the step of the other unknowns.
        pose: (4, 4) ``odom_T_body`` before, of the state that sees it first.
        moved_pose: (4, 4) after.
        body_T_cam: (4, 4) pose of the camera that sees it first.
        step: (6,) of the pose.
        max_farther: largest relative step to a smaller inverse depth that is taken as a step of the depth. Steps of the
            depth allow any change of the scale; steps of the inverse depth reach points that are nearly at infinity.
        work: (4, 3) for intermediate results.
        moved: (3,) output.
    """
    by = work[3]
    for r in range(3):
        by[r] = 0.0
        for c in range(3):
            by[r] -= inverse[r, c] * gradient[c]
    if _moved_with_camera(frame, landmark, by, pose, body_T_cam, step, max_farther, work, moved):
        put(frame, se3_compose(moved_pose, body_T_cam))
    else:
        for r in range(3):
            moved[r] = landmark[r] + by[r]


@kernel
def _moved_with_camera(
    frame: Float, landmark: Float, by: Float, pose: Float, body_T_cam: Float, step: Float, max_farther: float,
    work: Float, moved: Float,
) -> bool:  # fmt: skip
    """Fill in the landmark (3,), in the frame of the camera, after its own step (3,) and that of the body (6,).

    Args:
        frame: (4, 4) frame of the landmark in odom.
        landmark: (3,) before.
        by: (3,) its own step, in its frame before.
        pose: (4, 4) ``odom_T_body`` before.
        body_T_cam: (4, 4).
        step: (6,) of the pose.
        max_farther: as in `move_landmark`.
        work: (4, 3) for intermediate results, of which three rows are used.
        moved: (3,) output.

    Returns:
        Whether the landmark is in front of the camera.
    """
    odom, body, cam, w = work[0], work[1], work[2], landmark[2]
    # The landmark in body and in the camera, homogeneous.
    for r in range(3):
        odom[r] = frame[r, 0] * landmark[0] + frame[r, 1] * landmark[1] + frame[r, 2] + w * (frame[r, 3] - pose[r, 3])
    for r in range(3):
        body[r] = pose[0, r] * odom[0] + pose[1, r] * odom[1] + pose[2, r] * odom[2]
    x, y, z = body[0], body[1], body[2]
    for r in range(3):
        cam[r] = 0.0
        for c in range(3):
            cam[r] += body_T_cam[c, r] * (body[c] - w * body_T_cam[c, 3])
    if not cam[2] > MIN_DEPTH_RATIO:
        return False
    at_x, at_y, depth, at_w = cam[0] / cam[2], cam[1] / cam[2], cam[2], w / cam[2]
    # Its change to first order: by its own step, and by the rotation and translation of the body.
    for r in range(3):
        odom[r] = frame[r, 0] * by[0] + frame[r, 1] * by[1] + by[2] * (frame[r, 3] - pose[r, 3])
    for r in range(3):
        body[r] = pose[0, r] * odom[0] + pose[1, r] * odom[1] + pose[2, r] * odom[2] - w * step[3 + r]
    body[0] -= step[1] * z - step[2] * y
    body[1] -= step[2] * x - step[0] * z
    body[2] -= step[0] * y - step[1] * x
    for r in range(3):
        cam[r] = 0.0
        for c in range(3):
            cam[r] += body_T_cam[c, r] * (body[c] - by[2] * body_T_cam[c, 3])
    moved[0] = at_x + (cam[0] - at_x * cam[2]) / depth
    moved[1] = at_y + (cam[1] - at_y * cam[2]) / depth
    nearer = (by[2] - at_w * cam[2]) / depth
    if at_w > 0.0 and -max_farther * at_w < nearer < _MAX_NEARER * at_w:
        moved[2] = at_w / (1.0 - nearer / at_w)  # a step of the depth
    else:
        moved[2] = at_w + nearer
    return True
