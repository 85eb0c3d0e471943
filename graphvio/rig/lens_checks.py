"""Plausibility checks of a lens from a file: coefficients, intrinsics, and whether rays reach the image's corners."""

from __future__ import annotations

import numpy as np

from graphvio.arrays import Float
from graphvio.cameras import COEFFICIENTS, EQUIDISTANT, MODEL_NAMES, RADIAL_TANGENTIAL, ray_of

_ROUNDING = 1e-6
_FOCAL_RANGE = (0.05, 57.3)  # fraction of the image's larger side: wider than any lens, and a view of one degree
_MAX_OUTSIDE = 0.25  # fraction of the image's side; the principal point of a cropped image may lie outside of it


def lens_fault(model: str, distortion: Float) -> str:
    """Return a message on distortion coefficients that are out of range, with the remedy, or an empty string.

    Args:
        model: name of the lens model.
        distortion: coefficients (8,).
    """
    names = COEFFICIENTS[model]
    order = f"give {model} the coefficients {', '.join(names)} in this order"
    too_many = np.abs(distortion[len(names) :]) > _ROUNDING
    if too_many.any():
        last = len(names) + int(np.flatnonzero(too_many)[-1]) + 1
        return f"has {last} distortion coefficients, and {model} has {len(names)}; {order}"
    of = dict(zip(names, distortion.tolist(), strict=False))
    if not 0.0 <= of.get("alpha", 0.0) <= 1.0:
        return f"alpha is {of['alpha']:g}, and must be between 0 and 1; {order}"
    if not of.get("beta", 1.0) > 0.0:
        return f"beta is {of['beta']:g}, and must be positive; {order}"
    if not of.get("xi", 0.0) > -1.0:
        return f"xi is {of['xi']:g}, and must be more than -1; {order}"
    if model == "double-sphere" and of["xi"] > 1.0:
        return f"xi is {of['xi']:g}, and must be at most 1; {order}"
    return ""


def intrinsics_fault(focal_px: float, intrinsics: Float, size_px: tuple[int, int]) -> str:
    """Return a message on intrinsics that no lens has, such as those in other units than pixels, or an empty string.

    Args:
        focal_px: `Camera.focal_px`, the scale at the image centre.
        intrinsics: (4,) pixels.
        size_px: image size (width, height).
    """
    width, height = size_px
    cx, cy = intrinsics[2:].tolist()
    wanted = "intrinsics are fx, fy, cx, cy in this order, in pixels of an image of that size"
    if not _FOCAL_RANGE[0] <= focal_px / max(size_px) <= _FOCAL_RANGE[1]:
        return f"a focal length of {focal_px:g} px is of no lens with an image of {width}x{height}; {wanted}"
    if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > 0.5 + _MAX_OUTSIDE:
        return f"its principal point ({cx:g}, {cy:g}) is far outside of the image of {width}x{height}; {wanted}"
    return ""


def view_fault(model: str, intrinsics: Float, distortion: Float, size_px: tuple[int, int]) -> str:
    """Return a message on an image corner that no ray reaches, at any angle, with the remedy, or an empty string.

    Args:
        model: name of the lens model; with ``radial-tangential`` and ``equidistant`` nothing is tested.
        intrinsics: (4,) pixels.
        distortion: coefficients (8,).
        size_px: image size (width, height).
    """
    number = MODEL_NAMES[model]
    if number in (RADIAL_TANGENTIAL, EQUIDISTANT):
        return ""
    fx, fy, cx, cy = intrinsics.tolist()
    for u in (0, size_px[0] - 1):
        for v in (0, size_px[1] - 1):
            if not ray_of(number, distortion, (u - cx) / fx, (v - cy) / fy)[3]:
                return (
                    f"no ray reaches the image's corner ({u}, {v}) by its {model} lens; check intrinsics, size and "
                    f"coefficients ({', '.join(COEFFICIENTS[model])}), or give a mask if the corners are black"
                )
    return ""
