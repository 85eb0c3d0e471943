"""Rigs of cameras with factory calibrations: of one camera, or of several with guessed transforms between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphvio.errors import RigError, SourceError
from graphvio.geometry import se3, se3_inverse, so3_exp
from graphvio.rig import Rig, StereoPair


def checked_rig(rig: Rig, size_px: tuple[int, int], has_imu: bool, kind: str) -> Rig:
    """Check that a given rig fits the images.

    Args:
        rig: given.
        size_px: (width, height) of all images.
        has_imu: whether the devices deliver IMU samples.
        kind: of source, for messages.

    Returns:
        The rig, without its IMU where the devices have none.

    Raises:
        RigError: if it is for images of another size.
    """
    for camera in rig.cameras:
        if camera.size_px != size_px:
            raise RigError(
                f"{kind}: images are {size_px[0]}x{size_px[1]}, but the rig has {camera.name} with "
                f"{camera.size_px[0]}x{camera.size_px[1]}; choose size= as in the rig, or calibrate at this size"
            )
    return rig if has_imu else rig.without_imu()


def refuse_unknown_places(kind: str, devices: Sequence[str]) -> Rig:
    """Refuse several cameras without a rig file, as the transforms between them are unknown.

    Args:
        kind: of source.
        devices: names of the cameras.

    Raises:
        RigError: always.
    """
    names = ",".join(devices)
    raise RigError(
        f"{kind}: each camera has its own calibration, but not the transforms between {len(devices)} of them; give "
        f"a rig file (--rig rig.yaml). To make one, record a walk from '{kind}:{names}?places=guess' and calibrate it: "
        "graphvio calibrate RECORDING --out rig.yaml"
    )


def guessed_rig(rigs: Sequence[Rig], name: str) -> Rig:
    """Combine rigs of one pair each to one that only serves to record a session for `graphvio calibrate`.

    The first keeps its pose and its IMU; the others are at the same position, rotated about the vertical by equal
    steps: two look forwards and backwards. Cameras are named ``cam0``, ``cam1`` and so on.

    Args:
        rigs: of the cameras.
        name: of the combined rig.
    """
    body_T_left0 = rigs[0].pairs[0].left.body_T_cam
    pairs = []
    for k, rig in enumerate(rigs):
        pair = rig.pairs[0]
        left0_R_leftk = so3_exp(np.array([0.0, 2.0 * np.pi * k / len(rigs), 0.0]))
        body_T_left = body_T_left0 @ se3(left0_R_leftk, np.zeros(3))
        body_T_right = body_T_left @ se3_inverse(pair.right_T_left)
        left = replace(pair.left, name=f"cam{2 * k}", body_T_cam=body_T_left)
        right = replace(pair.right, name=f"cam{2 * k + 1}", body_T_cam=body_T_right)
        pairs.append(StereoPair(f"pair{k}", left, right))
    return Rig(tuple(pairs), rigs[0].imu, name)


def camera_names(rig: Rig | None, k: int) -> tuple[str, str]:
    """Return the names of the left and right camera of device ``k``: the rig's, or those of `guessed_rig`."""
    if rig is None:
        return f"cam{2 * k}", f"cam{2 * k + 1}"
    return rig.pairs[k].left.name, rig.pairs[k].right.name


def check_one_for_each_pair(kind: str, names: Sequence[str], rig: Rig | None, named: str) -> None:
    """Check that there is a camera for each pair of a given rig.

    Args:
        kind: of source.
        names: of the cameras.
        rig: given, or None.
        named: what identifies a camera, for messages.

    Raises:
        SourceError: if their numbers differ.
    """
    if rig is not None and len(names) != len(rig.pairs):
        raise SourceError(
            f"{kind}: {len(names)} cameras, but the rig has {len(rig.pairs)} pairs; name the {named} of one for each "
            f"pair, in the rig's order: {kind}:FIRST,SECOND"
        )
