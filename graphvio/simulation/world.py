"""What there is to see: textured rectangles, some of them on parts that move.

Frame ``world``: z up, metres. A rectangle runs from its upper left corner along ``edge_u`` (to the right, as
seen from the side that is looked at) and ``edge_v`` (down); ``edge_v x edge_u`` points to that viewer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from graphvio.arrays import Float
from graphvio.geometry import se3
from graphvio.simulation.default_rig import rotation_zyx
from graphvio.simulation.motion import Motion

_POSTER_STANDS_OUT_M = 0.008
_POSTER_STEP_M = 0.0015  # posters that overlap must not lie in one plane


@dataclass(frozen=True, eq=False)
class Rectangle:
    """One textured rectangle.

    Attributes:
        origin: (3,) upper left corner, metres.
        edge_u: (3,) to the right, metres.
        edge_v: (3,) down, metres.
        texture: name in the atlas.
        fit: whether the texture is stretched over the rectangle once instead of repeated.
        shift: (2,) start of a repeated texture, in repetitions.
        tint: factor on the reflectance.
        lit_evenly: whether it is lit without lamps and shadows, for walls without a feature.
        casts_shadow: whether lamps are blocked by it.
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
    """A lamp that shines in all directions: position (3,) in metres, and its light at one metre."""

    position: Float
    power: float


@dataclass(frozen=True, eq=False)
class MovingPart:
    """Rectangles in a frame ``part`` of their own, and ``world_T_part`` (4, 4) at a time in seconds."""

    rectangles: tuple[Rectangle, ...]
    world_T_part: Callable[[float], Float]


@dataclass(eq=False)
class World:
    """All that can be seen, built up by the methods below.

    Attributes:
        rectangles: those that stand still.
        moving: parts that move.
        lamps: light sources.
        ambient: light that comes from everywhere, as a fraction of full.
    """

    rectangles: list[Rectangle] = field(default_factory=list)
    moving: list[MovingPart] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)
    ambient: float = 0.3
    _posters: int = 0
    _shifts: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def wall(
        self,
        start: tuple[float, float],
        end: tuple[float, float],
        z0: float,
        z1: float,
        texture: str,
        tint: float = 1.0,
    ) -> None:
        """A vertical wall; the space that it is seen from lies to the right of the way from start to end."""
        a, b = np.array([*start, z1]), np.array([*end, z1])
        self._add(a, b - a, np.array([0.0, 0.0, z0 - z1]), texture, tint)

    def outline(self, corners: Sequence[tuple[float, float]], z0: float, z1: float, textures: Sequence[str]) -> None:
        """Walls around a closed space whose corners are given clockwise from above, one texture for each."""
        for i, texture in enumerate(textures):
            self.wall(corners[i], corners[(i + 1) % len(corners)], z0, z1, texture)

    def floor(self, x: tuple[float, float], y: tuple[float, float], z: float, texture: str, tint: float = 1.0) -> None:
        """A horizontal surface that is seen from above."""
        self._add(
            np.array([x[0], y[1], z]),
            np.array([x[1] - x[0], 0.0, 0.0]),
            np.array([0.0, y[0] - y[1], 0.0]),
            texture,
            tint,
        )

    def ceiling(self, x: tuple[float, float], y: tuple[float, float], z: float, texture: str) -> None:
        """A horizontal surface that is seen from below."""
        self._add(
            np.array([x[0], y[0], z]),
            np.array([x[1] - x[0], 0.0, 0.0]),
            np.array([0.0, y[1] - y[0], 0.0]),
            texture,
            1.0,
        )

    def poster(
        self,
        start: tuple[float, float],
        end: tuple[float, float],
        z0: float,
        z1: float,
        texture: str,
        tint: float = 1.0,
    ) -> None:
        """A flat thing hung on a wall between two points of its line, with the wall's direction."""
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
        """A box by its lower face's centre and its size, turned by yaw; ``front`` is for its x faces."""
        world_T_box = se3(rotation_zyx(yaw, 0.0, 0.0), np.array(centre))
        shift = tuple(self._shifts.random(2))
        for face in box_faces(size, texture, front, tint, (shift[0], shift[1])):
            self.rectangles.append(placed(face, world_T_box))

    def _add(self, origin: Float, edge_u: Float, edge_v: Float, texture: str, tint: float) -> None:
        shift = self._shifts.random(2)
        even = texture == "blank"
        self.rectangles.append(
            Rectangle(
                origin,
                edge_u,
                edge_v,
                texture,
                shift=(float(shift[0]), float(shift[1])),
                tint=tint,
                lit_evenly=even,
            )
        )


def placed(rectangle: Rectangle, a_T_b: Float) -> Rectangle:
    """A rectangle of frame b in frame a."""
    rotation = a_T_b[:3, :3]
    return Rectangle(
        rotation @ rectangle.origin + a_T_b[:3, 3],
        rotation @ rectangle.edge_u,
        rotation @ rectangle.edge_v,
        rectangle.texture,
        rectangle.fit,
        rectangle.shift,
        rectangle.tint,
        rectangle.lit_evenly,
        rectangle.casts_shadow,
    )


def box_faces(
    size: tuple[float, float, float],
    texture: str,
    front: str | None = None,
    tint: float = 1.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> tuple[Rectangle, ...]:
    """Six faces of a box whose lower face is centred on the origin; ``front`` is stretched over +x and -x."""
    hx, hy, height = 0.5 * size[0], 0.5 * size[1], size[2]
    ring = [(-hx, -hy), (hx, -hy), (hx, hy), (-hx, hy)]  # counterclockwise: the outside is to the right
    faces = []
    for i in range(4):
        a, b = np.array([*ring[i], height]), np.array([*ring[(i + 1) % 4], height])
        on_front = front is not None and i in (1, 3)
        faces.append(
            Rectangle(
                a,
                b - a,
                np.array([0.0, 0.0, -height]),
                front if on_front and front else texture,
                on_front,
                (shift[0] + 0.37 * i, shift[1]),
                tint,
            )
        )
    u, v = np.array([size[0], 0.0, 0.0]), np.array([0.0, size[1], 0.0])
    faces.append(Rectangle(np.array([-hx, hy, height]), u, -v, texture, False, shift, tint))
    faces.append(Rectangle(np.array([-hx, -hy, 0.0]), u, v, texture, False, shift, tint))
    return tuple(faces)


@dataclass(frozen=True)
class Exposure:
    """How the sensor is driven: ``light`` of the scene (1 is full), and ``gain`` of the auto-exposure."""

    light: float
    gain: float


def full_light(time_s: float) -> Exposure:
    """The exposure of a scene whose lamps never change."""
    return Exposure(light=1.0, gain=1.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A world, a motion through it and its light.

    Attributes:
        name: as the command line knows it.
        world: what there is to see.
        motion: of the body; its length is the recording's.
        exposure: light and gain at a time in seconds.
        events: name -> (start, end) in seconds of what the scene is there for.
    """

    name: str
    world: World
    motion: Motion
    exposure: Callable[[float], Exposure] = full_light
    events: dict[str, tuple[float, float]] = field(default_factory=dict)
