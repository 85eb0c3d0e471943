"""Normal equations of a window's poses and cameras, with the landmarks of `graphvio.monocular.structure` eliminated."""

from typing import NamedTuple

import numpy as np

from graphvio.arrays import Bool, Float
from graphvio.kernels import kernel, vector_kernel
from graphvio.monocular.reprojection import (
    COLUMNS,
    ERROR_AT,
    OF_STATE,
    POINT_AT,
    POSE,
    POSE_AT,
    Cameras,
    have_moved,
    whiten_view,
)
from graphvio.monocular.structure import (
    PRIOR_INFORMATION,
    PRIOR_INVERSE_DEPTH,
    Eliminated,
    Structure,
)
from graphvio.self_calibration.bundle import inverse3
from graphvio.self_calibration.parameters import CAMERA, SINGLE

_ERROR2_BEHIND = 1e6  # squared whitened error of a landmark behind the camera
_MAX_INVERSE_DEPTH = PRIOR_INFORMATION**-0.5  # 10 / m; nearer landmarks are mismatches, and would hold the poses


class _Sums(NamedTuple):
    """Sums of `visual_equations` for V cameras and K poses, and terms of the landmark that is being eliminated.

    Attributes:
        of_states: (K V, 6, 24) sums over all views of a camera from a state, by the columns of `whiten_view`.
        of_cameras: (V V, SINGLE, 16) likewise, of the parameters of one camera with those of another one and the error.
        coupled: (3, 6 K + n) couplings of the landmark with all unknowns.
        weighed: (3, 6 K + n) these couplings, multiplied by the landmark's inverse normal matrix.
        seen: (V,) whether each camera sees the landmark, where the cameras' calibration is unknown.
        by_camera: (V, 3, 16) couplings of the landmark with each camera's calibration.
        of_camera: (3, 16) those with one camera, multiplied by the landmark's inverse normal matrix.
        normal: (3, 3) upper triangle of the landmark's normal matrix.
        gradient: (3,) gradient of the cost with respect to the landmark.
    """

    of_states: Float
    of_cameras: Float
    coupled: Float
    weighed: Float
    seen: Bool
    by_camera: Float
    of_camera: Float
    normal: Float
    gradient: Float


@kernel
def _new_sums(n_poses: int, n_cameras: int, n_calibration: int) -> _Sums:
    """Allocate the sums."""
    size = POSE * n_poses + n_calibration
    return _Sums(
        np.zeros((n_poses * n_cameras, POSE, OF_STATE)), np.zeros((n_cameras * n_cameras, SINGLE, POSE_AT)),
        np.zeros((3, size)), np.zeros((3, size)), np.zeros(n_cameras, dtype=np.bool_),
        np.zeros((n_cameras, 3, POSE_AT)), np.zeros((3, POSE_AT)), np.zeros((3, 3)), np.zeros(3),
    )  # fmt: skip


@vector_kernel
def visual_equations(
    poses: Float, falls: Float, cameras: Cameras, landmarks: Float, structure: Structure, sigma_px: float,
    depth_information: float, scale: float, eliminated: Eliminated,
) -> tuple[Float, Float, float, Float]:  # fmt: skip
    """Linearise the reprojection errors, with the landmarks eliminated.

    Args:
        poses: (K, 4, 4) ``odom_T_body``; perturbed on the right, ``R Exp(r)``, ``p + R t``.
        falls: (K, 2, 3) motion of body in free fall, for rolling shutters, see `graphvio.monocular.states.States`.
        cameras: cameras that see the landmarks.
        landmarks: (L, 3).
        structure: views of the landmarks.
        sigma_px: noise of a corner's position.
        depth_information: information of the prior that an inverse depth is `PRIOR_INVERSE_DEPTH`, m^2.
        scale: scale of the Cauchy cost, in whitened units.
        eliminated: output; its size says whether the cameras' calibration is unknown, too.

    Returns:
        Hessian (6 K + n, 6 K + n) and gradient (6 K + n,) of poses and n parameters of cameras, robust cost, and
        squared whitened errors (N,).
    """
    n_calibration, n_cameras = eliminated.by_cameras.shape[2], len(cameras.focal_px)
    size, calibrates = POSE * len(poses) + n_calibration, n_calibration > 0
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    errors2, cost, rows = np.zeros(len(structure.state)), 0.0, np.zeros((2, COLUMNS))
    # Lengths 16 and 24, hidden from the compiler: if it knew them, it would unroll the loops and not vectorise them.
    of_one, of_both = 4 * cameras.intrinsics.shape[1], 6 * cameras.intrinsics.shape[1]
    per_scale2 = 1.0 / (scale * scale)
    by_lens = np.zeros((2 if calibrates or have_moved(cameras) else 0, CAMERA))
    sums = _new_sums(len(poses), n_cameras, n_calibration)
    for point in range(len(landmarks)):
        first, last = structure.rows[point], structure.rows[point + 1]
        if last <= first:
            continue
        begin, end = POSE * structure.state[first], POSE * (structure.state[last - 1] + 1)
        away = landmarks[point, 2] - PRIOR_INVERSE_DEPTH
        cost += 0.5 * depth_information * away * away
        _begin_landmark(sums, begin, end, of_one, depth_information, away)
        is_possible = abs(landmarks[point, 2]) <= _MAX_INVERSE_DEPTH  # else it goes back to its prior
        for n in range(first, last):
            k, j = structure.state[n], structure.camera[n]
            in_front = is_possible and whiten_view(
                poses[k], falls[k], cameras, j, structure.odom_T_landmark[point], landmarks[point],
                structure.rays[n], structure.readout[n], sigma_px, True, by_lens, rows,
            )  # fmt: skip
            u, v = rows[0], rows[1]
            e2 = u[ERROR_AT] * u[ERROR_AT] + v[ERROR_AT] * v[ERROR_AT] if in_front else _ERROR2_BEHIND
            errors2[n] = e2
            cost += 0.5 * scale * scale * np.log(1.0 + e2 * per_scale2)
            if not in_front:
                for r in range(3):
                    for c in range(POSE):
                        eliminated.by_pose[n, r, c] = 0.0
                continue
            root_weight = np.sqrt(1.0 / (1.0 + e2 * per_scale2))
            for c in range(of_both + 3):
                u[c] *= root_weight
                v[c] *= root_weight
            _add_view(u, v, k, j, n_cameras, calibrates, of_one, of_both, sums, eliminated.by_pose[n])
        _eliminate(point, structure, len(poses), n_cameras, of_one, sums, hessian, gradient, eliminated)
    _assemble(sums, len(poses), n_cameras, calibrates, hessian, gradient)
    return hessian, gradient, cost, errors2


@vector_kernel
def _begin_landmark(sums: _Sums, begin: int, end: int, of_one: int, information: float, away: float) -> None:
    """Reset the sums for a landmark, and add its prior.

    Args:
        sums: is changed.
        begin: first column of the poses that may see the landmark.
        end: end of these columns.
        of_one: 16.
        information: information of the prior inverse depth.
        away: difference of the inverse depth from its prior.
    """
    normal, gradient = sums.normal, sums.gradient
    for r in range(3):
        gradient[r] = 0.0
        for c in range(3):
            normal[r, c] = 0.0
        for c in range(begin, end):
            sums.coupled[r, c] = 0.0
    normal[0, 0], normal[1, 1], normal[2, 2] = 1e-9, 1e-9, information
    gradient[2] = information * away
    for j in range(len(sums.seen)):
        sums.seen[j] = False
        for r in range(3):
            for c in range(of_one):
                sums.by_camera[j, r, c] = 0.0


@vector_kernel
def _add_view(
    u: Float, v: Float, k: int, j: int, n_cameras: int, calibrates: bool, of_one: int, of_both: int, sums: _Sums,
    by_pose: Float,
) -> None:  # fmt: skip
    """Add a view to the sums of its landmark, its state and its camera.

    Args:
        u: (COLUMNS,) derivatives of the error in x, and that error.
        v: (COLUMNS,) the same of the error in y.
        k: index of the state.
        j: index of the camera.
        n_cameras: number of cameras of the rig.
        calibrates: whether the cameras' calibration is unknown.
        of_one: 16, number of columns of a camera and the error.
        of_both: 24, number of columns with the pose, too.
        sums: are added to.
        by_pose: (3, 6) output, coupling of the landmark with the pose.
    """
    for r in range(3):
        pu, pv = u[POINT_AT + r], v[POINT_AT + r]
        sums.gradient[r] += pu * u[ERROR_AT] + pv * v[ERROR_AT]
        for c in range(r, 3):
            sums.normal[r, c] += pu * u[POINT_AT + c] + pv * v[POINT_AT + c]
        for c in range(POSE):
            by_pose[r, c] = pu * u[POSE_AT + c] + pv * v[POSE_AT + c]
            sums.coupled[r, POSE * k + c] += by_pose[r, c]
    of_state = sums.of_states[k * n_cameras + j]
    for c in range(POSE):
        cu, cv = u[POSE_AT + c], v[POSE_AT + c]
        of_state[c, ERROR_AT] += 0.0 if calibrates else cu * u[ERROR_AT] + cv * v[ERROR_AT]
        if calibrates:
            for d in range(of_both):
                of_state[c, d] += cu * u[d] + cv * v[d]
        else:
            for d in range(of_one, of_both):
                of_state[c, d] += cu * u[d] + cv * v[d]
    if not calibrates:
        return
    sums.seen[j] = True
    of_camera = sums.of_cameras[j * n_cameras + j]
    for c in range(SINGLE):
        cu, cv = u[c], v[c]
        for d in range(of_one):
            of_camera[c, d] += cu * u[d] + cv * v[d]
    for r in range(3):
        pu, pv = u[POINT_AT + r], v[POINT_AT + r]
        for c in range(of_one):
            sums.by_camera[j, r, c] += pu * u[c] + pv * v[c]


@vector_kernel
def _eliminate(
    point: int, structure: Structure, n_states: int, n_cameras: int, of_one: int, sums: _Sums, hessian: Float,
    gradient: Float, eliminated: Eliminated,
) -> None:  # fmt: skip
    """Eliminate a landmark once all its views are added.

    Args:
        point: index of the landmark.
        structure: views of all landmarks.
        n_states: number K of states.
        n_cameras: number of cameras of the rig.
        of_one: 16.
        sums: are changed.
        hessian: (6 K + n, 6 K + n) is changed.
        gradient: (6 K + n,) is changed.
        eliminated: output; its couplings of the landmark with the poses are input.
    """
    states = structure.state[structure.rows[point]], structure.state[structure.rows[point + 1] - 1] + 1
    begin, end, n_poses = POSE * states[0], POSE * states[1], POSE * n_states
    inverse, coupled, weighed = eliminated.inverse[point], sums.coupled, sums.weighed
    inverse3(sums.normal, inverse)
    for r in range(3):
        eliminated.gradient[point, r] = sums.gradient[r]
    _weigh(inverse, coupled, begin, end, weighed, sums.gradient, gradient)
    for c in range(begin, end):
        _subtract(coupled, weighed, c, c, end, hessian)
    for j in range(n_cameras):
        if not sums.seen[j]:
            continue
        at = n_poses + SINGLE * j
        for r in range(3):
            for c in range(SINGLE):
                coupled[r, at + c] = eliminated.by_cameras[point, r, SINGLE * j + c] = sums.by_camera[j, r, c]
        _weigh(inverse, coupled, at, at + SINGLE, weighed, sums.gradient, gradient)
        for r in range(3):
            for c in range(SINGLE):
                sums.of_camera[r, c] = weighed[r, at + c]
        for k in range(states[0], states[1]):
            _subtract_block(coupled, POSE * k, sums.of_camera, of_one, sums.of_states[k * n_cameras + j])
        for i in range(j + 1):
            if sums.seen[i]:
                of_both = sums.of_cameras[i * n_cameras + j]
                _subtract_block(coupled, n_poses + SINGLE * i, sums.of_camera, of_one, of_both)


@vector_kernel
def _assemble(sums: _Sums, n_states: int, n_cameras: int, calibrates: bool, hessian: Float, gradient: Float) -> None:
    """Add the sums of states and cameras to the normal equations, and fill the lower triangle."""
    n_poses = POSE * n_states
    for k in range(n_states):
        for j in range(n_cameras):
            of_state, at, at_camera = sums.of_states[k * n_cameras + j], POSE * k, n_poses + SINGLE * j
            for c in range(POSE):
                gradient[at + c] += of_state[c, ERROR_AT]
                for d in range(POSE):
                    hessian[at + c, at + d] += of_state[c, POSE_AT + d]
                for d in range(SINGLE if calibrates else 0):
                    hessian[at + c, at_camera + d] += of_state[c, d]
    for i in range(n_cameras if calibrates else 0):
        for j in range(i, n_cameras):
            of_both, at, other = sums.of_cameras[i * n_cameras + j], n_poses + SINGLE * i, n_poses + SINGLE * j
            for c in range(SINGLE):
                gradient[at + c] += of_both[c, ERROR_AT]
                for d in range(SINGLE):
                    hessian[at + c, other + d] += of_both[c, d]
    for c in range(len(gradient)):
        for d in range(c):
            hessian[c, d] = hessian[d, c]


@vector_kernel
def _weigh(
    inverse: Float, coupled: Float, begin: int, end: int, weighed: Float, of_landmark: Float, gradient: Float
) -> None:
    """Multiply a landmark's couplings with some unknowns by its inverse normal matrix, and eliminate its gradient.

    Args:
        inverse: (3, 3) inverse of the landmark's normal matrix.
        coupled: (3, n) couplings with all unknowns.
        begin: index of the first of the unknowns.
        end: end of the unknowns.
        weighed: (3, n) output, in the columns of the unknowns.
        of_landmark: (3,) gradient of the landmark.
        gradient: (n,) is changed.
    """
    b0, b1, b2 = of_landmark[0], of_landmark[1], of_landmark[2]
    if begin < 0:
        return  # never happens: it shows the compiler that no index is negative
    for c in range(begin, end):
        a0, a1, a2 = coupled[0, c], coupled[1, c], coupled[2, c]
        t0 = inverse[0, 0] * a0 + inverse[0, 1] * a1 + inverse[0, 2] * a2
        t1 = inverse[1, 0] * a0 + inverse[1, 1] * a1 + inverse[1, 2] * a2
        t2 = inverse[2, 0] * a0 + inverse[2, 1] * a1 + inverse[2, 2] * a2
        weighed[0, c], weighed[1, c], weighed[2, c] = t0, t1, t2
        gradient[c] -= t0 * b0 + t1 * b1 + t2 * b2


@vector_kernel
def _subtract(coupled: Float, weighed: Float, row: int, begin: int, end: int, hessian: Float) -> None:
    """Subtract a landmark's share, as it is eliminated, from some columns of one row of the normal equations (n, n)."""
    a0, a1, a2 = coupled[0, row], coupled[1, row], coupled[2, row]
    if begin < 0 or (a0 == 0.0 and a1 == 0.0 and a2 == 0.0):  # the state does not see the landmark
        return
    for d in range(begin, end):
        hessian[row, d] -= a0 * weighed[0, d] + a1 * weighed[1, d] + a2 * weighed[2, d]


@vector_kernel
def _subtract_block(coupled: Float, at: int, of_camera: Float, n_columns: int, sums: Float) -> None:
    """Subtract a landmark's share, as it is eliminated, from the equations of a few unknowns with a camera.

    Args:
        coupled: (3, n) couplings with all unknowns.
        at: index of the first of the few unknowns.
        of_camera: (3, 16) the camera's couplings, multiplied by the inverse normal matrix; the last column is zero.
        n_columns: 16.
        sums: (R, 16 at least) sums of R unknowns, is changed.
    """
    for c in range(len(sums)):
        a0, a1, a2 = coupled[0, at + c], coupled[1, at + c], coupled[2, at + c]
        for d in range(n_columns):
            sums[c, d] -= a0 * of_camera[0, d] + a1 * of_camera[1, d] + a2 * of_camera[2, d]
