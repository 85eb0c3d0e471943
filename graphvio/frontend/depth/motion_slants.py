"""Slant of the surfaces that a single camera sees, from the deformation of a keyframe's patches in later images.

The keyframe and a later image are a stereo pair whose baseline is the motion: the patch of a slanted surface is sheared
along the epipolar line. If the slant is ignored, the shear is mistaken for a shift, in the same direction all over a
wall.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphvio.arrays import Bool, Float, Image, Int
from graphvio.frontend.depth.prediction import around, inverse_depths_around, stereo_warps
from graphvio.frontend.depth.slanted import align_slanted
from graphvio.frontend.depth.stereo import epipolar_lines
from graphvio.frontend.depth.tracks import TrackedFrame
from graphvio.frontend.imaging.sampling import pixel_words
from graphvio.rig import Camera

_MIN_PARALLAX_PX = 6.0  # shift of a patch that is due to its depth
_MORE_PARALLAX = 1.5  # factor over the parallax with which the patch was measured before
_TYPICAL_SLANT = 0.6  # tangent: standard deviation of each slope of a surface against the image
_SLOPE_SIGMA = 0.02  # of a measured slope, by which a patch is sheared
_VARIANCE_BY_STEREO = 0.1  # of a slant that another camera has measured, over that of an unknown one
_MIN_CORRELATION = 0.9
_MAX_SHIFT_PX = 0.3  # from where the patch was found before it was sheared
_MAX_RELATIVE_SLANT = 0.5  # change of a patch's inverse depth from its middle to its edge


class MotionSlants:
    """Measures slants of a keyframe's patches in later images of the same camera.

    Args:
        half: half the side of the patches, which have ``2 half + 1`` pixels on each side.
        step_px: step of `graphvio.frontend.depth.prediction.around`.
    """

    def __init__(self, half: int, step_px: float) -> None:
        self._half, self._step_px = half, step_px
        self._image: Image | None = None
        self._parallax_px: Float = np.zeros(0)  # with which each patch was measured last
        self._variances: Float = np.zeros(0)  # of slants, over that of an unknown slant

    def begin(self, image: Image) -> None:
        """Begin with the image (height, width) of another keyframe."""
        self._image = image
        # so that the first measurement needs the smallest parallax
        self._parallax_px = np.full(len(self._variances), _MIN_PARALLAX_PX / _MORE_PARALLAX)

    def hand_on(self, before: Int, now: Int, n_tracks: int) -> None:
        """Transfer the variances of K tracks' slants from rows (K,) before to rows now; other slants are unknown."""
        variances = np.ones(n_tracks)
        variances[now] = self._variances[before]
        self._variances = variances

    def note_measured(self, rows: Int) -> None:
        """Mark the slants of tracks, in rows (K,), as measured by another camera."""
        self._variances[rows] = _VARIANCE_BY_STEREO

    def measure(
        self, camera: Camera, keyframe: TrackedFrame, rows: Int, pixels: Float, image: Image, motion: Float,
        rays: Float, inverse_depths: Float,
    ) -> None:  # fmt: skip
        """Update inverse depths around the patches whose slant a new image shows better than earlier ones.

        With little parallax, the noise of a measured slant is larger than a usual slant: the measurement is weighted by
        its variance.

        Args:
            camera: the camera of all images.
            keyframe: the N tracks of the keyframe.
            rows: (M,) rows of the tracks that were found.
            pixels: (M, 2) where they were found.
            image: (height, width) the new image.
            motion: (4, 4) motion of points since the keyframe.
            rays: (5, N, 2) normalised coordinates around the tracks in the keyframe.
            inverse_depths: (5, N) there, 1/m; updated in place.
        """
        if self._image is None or not len(rows):
            return
        lens = camera.model_number, camera.intrinsics, camera.distortion
        depths = inverse_depths[0, rows]
        middle = np.ascontiguousarray(rays[0, rows])
        far, _, has_far = epipolar_lines(middle, np.zeros(len(rows)), motion, *lens)
        there, directions, valid = epipolar_lines(middle, depths, motion, *lens)
        parallax = np.linalg.norm(there - far, axis=1)
        wanted = valid & has_far & (parallax > _MORE_PARALLAX * self._parallax_px[rows])
        if not wanted.any():
            return
        rows, pixels, directions, depths = rows[wanted], pixels[wanted], directions[wanted], depths[wanted]
        middle, n = middle[wanted], len(rows)
        warps, bends = stereo_warps(middle, depths, motion, *lens, *lens)
        everything = np.ones(n, dtype=bool)
        moved, slopes, correlations, found = align_slanted(
            self._image, image, pixel_words(image), keyframe.pixels[rows], pixels, directions, warps, bends,
            np.zeros((n, 2)), everything, everything, self._half,
        )  # fmt: skip
        found &= (correlations > _MIN_CORRELATION) & (np.linalg.norm(moved - pixels, axis=1) < _MAX_SHIFT_PX)
        beside = inverse_depths_around(
            np.ascontiguousarray(rays[:, rows]), depths, slopes, self._step_px, motion, *lens
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            measured, known = beside / depths, inverse_depths[:, rows] / depths
        found &= _is_small(measured)
        rows, parallax = rows[found], parallax[wanted][found]
        variances = self._variances[rows]
        noise = (_SLOPE_SIGMA * camera.focal_px / (_TYPICAL_SLANT * parallax)) ** 2
        gains = variances / (variances + noise)
        known, measured = known[:, found], measured[:, found]
        inverse_depths[:, rows] = depths[found] * (known + gains * (measured - known))
        self._variances[rows] = (1.0 - gains) * variances
        self._parallax_px[rows] = parallax


def hand_on_slants(rays: Float, inverse_depths: Float, motion: Float, new_rays: Float, depths: Float) -> Float:
    """Compute inverse depths around tracks in a new keyframe, with the slants of the keyframe before.

    Args:
        rays: (5, N, 2) normalised coordinates around the tracks in the keyframe before.
        inverse_depths: (5, N) there, 1/m.
        motion: (4, 4) motion of points from that keyframe to the new one.
        new_rays: (5, N, 2) normalised coordinates around the tracks in the new keyframe.
        depths: (N,) inverse depths of the tracks there, 1/m.

    Returns:
        Inverse depths (5, N); around a track whose surface is seen nearly edge-on, all equal to the track's own.
    """
    planes = _planes(rays, inverse_depths) @ motion[:3, :3].T
    planes /= 1.0 + (planes @ motion[:3, 3])[:, None]
    middle = (planes * np.column_stack([new_rays[0], np.ones(len(planes))])).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = 1.0 + ((new_rays - new_rays[0]) * (planes[:, :2] / middle[:, None])).sum(axis=2)
    return depths * np.where(_is_small(factors), factors, 1.0)


def _is_small(factors: Float) -> Bool:
    """Check which slants (N,) are small enough for patches to look alike, by factors (5, N) on their inverse depths."""
    return np.asarray((np.abs(factors - 1.0) < _MAX_RELATIVE_SLANT).all(axis=0))


def _planes(rays: Float, inverse_depths: Float) -> Float:
    """Return the planes (N, 3) of patches: the product with ``[x, y, 1]`` is a ray's inverse depth."""
    a, b = (rays[2] - rays[1]).T
    c, d = (rays[4] - rays[3]).T
    right, down = inverse_depths[2] - inverse_depths[1], inverse_depths[4] - inverse_depths[3]
    area = a * d - b * c
    by_x, by_y = (right * d - down * b) / area, (down * a - right * c) / area
    return np.column_stack([by_x, by_y, inverse_depths[0] - by_x * rays[0, :, 0] - by_y * rays[0, :, 1]])


def warm_up_motion_slants(camera: Camera) -> None:
    """Compile the kernels that measure a slant, by measuring one in noise."""
    width, height = camera.size_px
    noise = np.random.default_rng(0).integers(0, 256, (2, height, width)).astype(np.uint8)
    pixels = around(np.array([[0.5 * width, 0.5 * height]]), 4.0)
    rays, motion = camera.unproject(pixels.reshape(-1, 2))[0].reshape(pixels.shape), np.eye(4)
    motion[0, 3] = 10.0 / camera.focal_px
    slants = MotionSlants(7, 4.0)
    slants.hand_on(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), 1)
    slants.begin(noise[0])
    keyframe = replace(TrackedFrame.empty(), pixels=pixels[0])
    slants.measure(camera, keyframe, np.zeros(1, dtype=np.int64), pixels[0], noise[1], motion, rays, np.ones((5, 1)))
