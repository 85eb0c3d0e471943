"""Whether two rigs have the same cameras at the same places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphvio.rig import Rig

_TOLERANCE = 1e-9  # a file keeps all digits; this is rounding


def difference(rig: Rig, other: Rig) -> str:
    """What tells the cameras of two rigs apart, in words; empty where nothing does. IMU and masks do not count."""
    names, others = [each.name for each in rig.cameras], [each.name for each in other.cameras]
    if names != others:
        return f"cameras {', '.join(names)} here, {', '.join(others)} there"
    for one, two in zip(rig.cameras, other.cameras, strict=True):
        if one.model != two.model or one.size_px != two.size_px:
            return f"{one.name} is {one.model} {one.size_px} here, {two.model} {two.size_px} there"
        for what in ("intrinsics", "distortion", "body_T_cam"):
            if not np.allclose(getattr(one, what), getattr(two, what), rtol=_TOLERANCE, atol=_TOLERANCE):
                return f"{what} of {one.name} differ"
    return ""


def without_masks(rig: Rig) -> Rig:
    """The same rig, whose file needs no others beside it."""
    pairs = tuple(
        replace(pair, left=replace(pair.left, mask=None), right=replace(pair.right, mask=None)) for pair in rig.pairs
    )
    return replace(rig, pairs=pairs)
