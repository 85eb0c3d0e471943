"""Worlds of textured rectangles, some of them on moving parts, and scenes: a world with a motion through it.

Frame ``world``: z up, metres. A rectangle extends from its upper left corner along ``edge_u`` (to the right, for a
viewer of its front side) and ``edge_v`` (down); ``edge_v x edge_u`` points to that viewer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3
from graphvio.simulation.default_rig import rotation_zyx
from graphvio.simulation.motion import Motion

Point = tuple[float, float]

_POSTER_STANDS_OUT_M = 0.008
_POSTER_STEP_M = 0.0015  # difference between the distances of two posters, as overlapping ones must not share a plane


@dataclass(frozen=True, eq=False)
class Rectangle:
    """One textured rectangle.

    Attributes:
        origin: (3,) upper left corner, metres.
        edge_u: (3,) to the right, metres.
        edge_v: (3,) down, metres.
        texture: name in the atlas.
        fit: whether the texture is scaled to the rectangle instead of repeated.
        shift: (2,) shift of a repeated texture, in repetitions.
        tint: factor of the reflectance.
        lit_evenly: whether the light on it is constant, without lamps and shadows, for walls without features.
        casts_shadow: whether it blocks the light of lamps.
    """

    origin: Float
    edge_u: Float
    edge_v: Float
    texture: str
    fit: bool = False
    shift: tuple[float, float] = (0.0, 0.0)
    tint: float = 1.0
    lit_evenly: bool = False
    casts_shadow: bool = True

    @property
    def normal(self) -> Float:
        """Unit normal (3,) towards the viewer."""
        normal = np.cross(self.edge_v, self.edge_u)
        return np.asarray(normal / np.linalg.norm(normal))


@dataclass(frozen=True, eq=False)
class Lamp:
    """A lamp that shines in all directions: position (3,) in metres, and power."""

    position: Float
    power: float


@dataclass(frozen=True, eq=False)
class MovingPart:
    """Rectangles in their own frame ``part``, and a function that returns ``world_T_part`` (4, 4) at a time (s)."""

    rectangles: tuple[Rectangle, ...]
    world_T_part: Callable[[float], Float]


@dataclass(eq=False)
class World:
    """A collection of surfaces and lamps, built up by the methods below.

    Attributes:
        rectangles: static rectangles.
        moving: moving parts.
        lamps: light sources.
        ambient: light from all directions, as a fraction of full light.
    """

    rectangles: list[Rectangle] = field(default_factory=list)
    moving: list[MovingPart] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)
    ambient: float = 0.3
    _posters: int = 0
    _shifts: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def wall(self, start: Point, end: Point, z0: float, z1: float, texture: str, tint: float = 1.0) -> None:
        """Add a vertical wall, whose front is on the right-hand side of the line from start to end."""
        a, b = np.array([*start, z1]), np.array([*end, z1])
        self._add(a, b - a, np.array([0.0, 0.0, z0 - z1]), texture, tint)

    def outline(self, corners: Sequence[Point], z0: float, z1: float, textures: Sequence[str]) -> None:
        """Add walls around a closed space, corners clockwise as seen from above, one texture for each wall."""
        for i, texture in enumerate(textures):
            self.wall(corners[i], corners[(i + 1) % len(corners)], z0, z1, texture)

    def floor(self, x: tuple[float, float], y: tuple[float, float], z: float, texture: str, tint: float = 1.0) -> None:
        """Add a horizontal surface that is seen from above."""
        edge_u, edge_v = np.array([x[1] - x[0], 0.0, 0.0]), np.array([0.0, y[0] - y[1], 0.0])
        self._add(np.array([x[0], y[1], z]), edge_u, edge_v, texture, tint)

    def ceiling(self, x: tuple[float, float], y: tuple[float, float], z: float, texture: str) -> None:
        """Add a horizontal surface that is seen from below."""
        edge_u, edge_v = np.array([x[1] - x[0], 0.0, 0.0]), np.array([0.0, y[1] - y[0], 0.0])
        self._add(np.array([x[0], y[0], z]), edge_u, edge_v, texture, 1.0)

    def poster(self, start: Point, end: Point, z0: float, z1: float, texture: str, tint: float = 1.0) -> None:
        """Add a flat object on a wall, from one point of the wall's line to another, in the wall's direction."""
        a, b = np.array([*start, z1]), np.array([*end, z1])
        right = (b - a) / np.linalg.norm(b - a)
        self._posters += 1
        lift = (_POSTER_STANDS_OUT_M + _POSTER_STEP_M * (self._posters % 11)) * np.cross(right, [0.0, 0.0, 1.0])
        down = np.array([0.0, 0.0, z0 - z1])
        self.rectangles.append(Rectangle(a + lift, b - a, down, texture, fit=True, tint=tint, casts_shadow=False))

    def box(
        self,
        centre: tuple[float, float, float],
        size: tuple[float, float, float],
        texture: str,
        yaw: float = 0.0,
        front: str | None = None,
        tint: float = 1.0,
    ) -> None:
        """Add a box with a given centre of its lower face, size and yaw; ``front`` is the texture of its x faces."""
        world_T_box = se3(rotation_zyx(yaw, 0.0, 0.0), np.array(centre))
        u, v = self._shifts.random(2)
        self.rectangles += [placed(face, world_T_box) for face in box_faces(size, texture, front, tint, (u, v))]

    def _add(self, origin: Float, edge_u: Float, edge_v: Float, texture: str, tint: float) -> None:
        u, v = self._shifts.random(2).tolist()
        is_blank = texture == "blank"
        self.rectangles.append(Rectangle(origin, edge_u, edge_v, texture, shift=(u, v), tint=tint, lit_evenly=is_blank))


def placed(rectangle: Rectangle, a_T_b: Float) -> Rectangle:
    """Transform a rectangle of frame b into frame a."""
    rotation = a_T_b[:3, :3]
    origin = rotation @ rectangle.origin + a_T_b[:3, 3]
    return replace(rectangle, origin=origin, edge_u=rotation @ rectangle.edge_u, edge_v=rotation @ rectangle.edge_v)


def box_faces(
    size: tuple[float, float, float],
    texture: str,
    front: str | None = None,
    tint: float = 1.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> tuple[Rectangle, ...]:
    """Return the faces of a box whose lower face is centred on the origin.

    Args:
        size: along x, y and z, metres.
        texture: name of the texture.
        front: texture that is scaled to each of the two x faces; None for ``texture`` on these, too.
        tint: factor of the reflectance.
        shift: shift of the repeated texture, in repetitions.
    """
    hx, hy, height = 0.5 * size[0], 0.5 * size[1], size[2]
    ring = [(-hx, -hy), (hx, -hy), (hx, hy), (-hx, hy)]  # counterclockwise: the outside is to the right
    faces = []
    for i in range(4):
        a, b = np.array([*ring[i], height]), np.array([*ring[(i + 1) % 4], height])
        is_front = front is not None and i in (1, 3)
        down, turned = np.array([0.0, 0.0, -height]), (shift[0] + 0.37 * i, shift[1])
        faces.append(Rectangle(a, b - a, down, front if is_front and front else texture, is_front, turned, tint))
    u, v = np.array([size[0], 0.0, 0.0]), np.array([0.0, size[1], 0.0])
    faces.append(Rectangle(np.array([-hx, hy, height]), u, -v, texture, False, shift, tint))
    faces.append(Rectangle(np.array([-hx, -hy, 0.0]), u, v, texture, False, shift, tint))
    return tuple(faces)


@dataclass(frozen=True)
class Exposure:
    """Light of the scene (1 is full light), and gain of the camera's automatic exposure."""

    light: float
    gain: float


def full_light(time_s: float) -> Exposure:
    """Return the exposure of a scene whose lamps never change."""
    return Exposure(light=1.0, gain=1.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A world, a motion through it and its light over time.

    Attributes:
        name: name of the scene, as on the command line.
        world: surfaces and lamps.
        motion: motion of the body; its duration is the recording's.
        exposure: returns light and gain at a time in seconds.
        events: difficult moments of the scene: name -> (start, end), in seconds.
        rig: name of the scene's own rig, one of `graphvio.simulation.named_rigs.NAMED_RIGS`.
        rate_hz: framesets per second of that rig.
    """

    name: str
    world: World
    motion: Motion
    exposure: Callable[[float], Exposure] = full_light
    events: dict[str, tuple[float, float]] = field(default_factory=dict)
    rig: str = "paper"
    rate_hz: float = 20.0
