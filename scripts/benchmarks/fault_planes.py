"""Objects that move in front of the cameras: a door that fills a view, people who cross it, a crowd that walks as one.

Each object is a textured plane in the world. It is rendered into both images of a pair with the pair's camera models,
so that its disparities, its motion and its lens distortion are those of a real object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from benchmarks.fault_images import Images, Moment
from benchmarks.fault_scenes import texture_map
from graphvio.arrays import AnyArray, Bool, Float, Image
from graphvio.cameras import project_points
from graphvio.geometry import se3, so3_exp
from graphvio.rig import Camera

_WHITE = 230.0  # grey levels of full reflectance
_PERSON_M = (0.55, 1.75)
_MARGIN_PX = 12  # distance by which distortion may bend an edge outwards
_DOORS = ("door", "brick", "poster1", "wood", "books")
_SHIRTS = ("stripes", "fabric", "poster2", "notices", "books", "poster0")


@dataclass(frozen=True, eq=False)
class Plane:
    """A textured rectangle.

    Attributes:
        world_T_plane: (4, 4) its pose: x to the right, y down, z away from the viewer.
        half_m: half its width and height, metres; infinite for a plane without edges.
        texture: name of one of the simulator's textures.
        tile_m: size of one repetition of the texture, metres.
        shift: shift of the texture, in repetitions.
    """

    world_T_plane: Float
    half_m: tuple[float, float]
    texture: str
    tile_m: float
    shift: float


def door_in_one_view(moment: Moment) -> Images:
    """A near, textured door that fills one pair's view and moves by itself, at 0.05 to 0.8 m/s, and turns."""
    draw, pair = moment.fixed(3), moment.one_pair()[0]
    velocity = _direction(draw) * float(np.exp(draw.uniform(np.log(0.05), np.log(0.8))))
    turning = so3_exp(np.array([0.0, draw.uniform(-0.4, 0.4) * moment.since_s, 0.0]))
    before_camera = se3(so3_exp(draw.uniform(-0.35, 0.35, 3)), np.array([0.0, 0.0, draw.uniform(0.8, 1.8)]))
    pose = _carried(moment, pair, before_camera, velocity)
    pose = pose @ se3(turning, np.zeros(3))
    door = Plane(pose, (np.inf, np.inf), str(draw.choice(_DOORS)), float(draw.uniform(0.8, 1.4)), float(draw.random()))
    return draw_planes(moment, [pair], [door])


def people_before_one_pair(moment: Moment) -> Images:
    """Three to six people who cross one pair's view, each with their own velocity."""
    pair = moment.one_pair()[0]
    return draw_planes(moment, [pair], _people(moment, pair, together=False))


def people_all_around(moment: Moment) -> Images:
    """People who cross the views of all pairs."""
    images = moment.images
    for pair in moment.all_pairs():
        images = {**images, **_only(draw_planes(moment, [pair], _people(moment, pair, together=False)), pair)}
    return images


def crowd_as_one(moment: Moment) -> Images:
    """Twelve people in front of every pair, who all walk with the same velocity, like a marching column."""
    images = moment.images
    for pair in moment.all_pairs():
        images = {**images, **_only(draw_planes(moment, [pair], _people(moment, pair, together=True)), pair)}
    return images


def draw_planes(moment: Moment, pairs: Sequence[int], planes: Sequence[Plane]) -> Images:
    """Return the images of a moment with planes rendered over both images of some pairs, nearer ones in front."""

    def change(pair: int, side: int, image: Image) -> Image:
        camera = moment.rig.pairs[pair].right if side else moment.rig.pairs[pair].left
        cam_T_world = camera.cam_T_body @ np.linalg.inv(moment.world_T_body)
        changed = image.astype(np.float32)
        depth = np.full(image.shape, np.inf, dtype=np.float32)
        for plane in planes:
            _draw(changed, depth, camera, cam_T_world @ plane.world_T_plane, plane)
        covered = np.isfinite(depth)
        noise = moment.noise(9, pair, side).standard_normal(image.shape, dtype=np.float32)
        changed[covered] += (noise * np.sqrt(0.02 * np.maximum(changed, 0.0) + 0.5))[covered]
        return np.clip(np.rint(changed), 0, 255).astype(np.uint8)

    return moment.altered(pairs, change)


def _people(moment: Moment, pair: int, *, together: bool) -> list[Plane]:
    draw = moment.fixed(4, pair)
    common = moment.fixed(5)  # the velocity of those who walk together: one for all pairs
    shared = np.array([*common.uniform(-0.7, 0.7, 2), 0.0])
    people = []
    for number in range(12 if together else int(draw.integers(3, 7))):
        distance = float(draw.uniform(1.0, 3.2))
        aside = float(draw.uniform(-0.9, 0.9)) * distance
        pace = float(draw.uniform(0.5, 1.5)) * (1.0 if number % 2 else -1.0)
        before_camera = se3(np.eye(3), np.array([aside, 0.25, distance]))
        velocity = shared if together else pace * moment.rig.pairs[pair].left.body_T_cam[:3, 0]
        if not together:
            before_camera[0, 3] -= 0.6 * pace  # they come into view, and leave it again
        pose = _carried(moment, pair, before_camera, velocity)
        shirt = _SHIRTS[int(draw.integers(len(_SHIRTS)))]
        half = (0.5 * _PERSON_M[0], 0.5 * _PERSON_M[1])
        people.append(Plane(pose, half, shirt, float(draw.uniform(0.5, 0.9)), float(draw.random())))
    return people


def _carried(moment: Moment, pair: int, left_T_plane: Float, own_velocity: Float) -> Float:
    """Return ``world_T_plane`` (4, 4) of an object that moves with the velocity that the rig had when the fault began.

    ``own_velocity`` (3,) m/s, relative to the rig, is added to it, in the frame body when the fault began.
    """
    pose = moment.world_T_body_then @ moment.rig.pairs[pair].left.body_T_cam @ left_T_plane
    own = moment.world_T_body_then[:3, :3] @ own_velocity
    pose[:3, 3] += (moment.velocity_then + own) * moment.since_s
    return np.asarray(pose)


def _draw(image: AnyArray, depth: AnyArray, camera: Camera, cam_T_plane: Float, plane: Plane) -> None:
    """Draw a plane into an image (H, W) in place where it is nearer than the depth (H, W); both are float32."""
    window = _window(camera, cam_T_plane, plane)
    rays, known = (values[window] for values in _rays(camera))
    if not known.any():
        return
    image, depth = image[window], depth[window]
    to_plane = np.linalg.inv(cam_T_plane[:3, [0, 1, 3]])
    scaled = rays @ to_plane.T.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(scaled[..., 2] > 1e-3, 1.0 / scaled[..., 2], np.inf).astype(np.float32)
        u, v = scaled[..., 0] * distance, scaled[..., 1] * distance
        inside = known & (distance < depth) & (distance > 0.15)
        if np.isfinite(plane.half_m[0]):
            inside &= (u / plane.half_m[0]) ** 4 + (v / plane.half_m[1]) ** 4 < 1.0
    if not inside.any():
        return
    texels = _texture(plane.texture, plane.tile_m * camera.focal_px / float(np.median(distance[inside])))
    side = texels.shape[0]
    at_u = np.where(inside, (u / plane.tile_m + plane.shift) * side, 0.0).astype(np.float32) % side
    at_v = np.where(inside, (v / plane.tile_m + plane.shift) * side, 0.0).astype(np.float32) % side
    seen = cv2.remap(texels, at_u, at_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    image[inside] = _WHITE * seen[inside]
    depth[inside] = distance[inside]


def _window(camera: Camera, cam_T_plane: Float, plane: Plane) -> tuple[slice, slice]:
    """Return the rows and columns that contain a plane's image; all of them if its corners are not in view."""
    if not np.isfinite(plane.half_m[0]):
        return slice(None), slice(None)
    corners = np.array([[x, y, 0.0, 1.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)]) * [*plane.half_m, 0.0, 1.0]
    points = np.ascontiguousarray((corners @ cam_T_plane.T)[:, :3])
    pixels, valid = project_points(camera.model_number, camera.intrinsics, camera.distortion, points)
    if not valid.all():
        return slice(None), slice(None)
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - _MARGIN_PX, 0)
    high = np.maximum(np.ceil(pixels.max(axis=0)).astype(int) + _MARGIN_PX, 0)
    return slice(low[1], high[1]), slice(low[0], high[0])


@cache
def _rays(camera: Camera) -> tuple[AnyArray, Bool]:
    """Return the directions ``[x, y, 1]`` (H, W, 3) float32 of a camera's pixels, and whether each has one (H, W)."""
    width, height = camera.size_px
    y, x = np.mgrid[0:height, 0:width]
    rays, known = camera.unproject(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
    directions = np.column_stack([rays, np.ones(len(rays))]).astype(np.float32)
    return directions.reshape(height, width, 3), known.reshape(height, width)


def _texture(name: str, pixels: float) -> AnyArray:
    """Return a texture with no more texels than the pixels that it covers, to avoid aliasing."""
    return _level(name, max(round(np.log2(512.0 / max(pixels, 8.0))), 0))


@cache
def _level(name: str, level: int) -> AnyArray:
    texels = texture_map(name)
    for _ in range(level):
        half = texels.shape[0] // 2
        texels = texels.reshape(half, 2, half, 2).mean(axis=(1, 3))
    return np.ascontiguousarray(texels, dtype=np.float32)


def _direction(draw: np.random.Generator) -> Float:
    vector = draw.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def _only(images: Images, pair: int) -> Images:
    return {pair: images[pair]}
