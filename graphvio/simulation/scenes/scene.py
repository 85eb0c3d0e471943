"""What a scene is made of."""

from collections.abc import Callable
from dataclasses import dataclass, field

from graphvio.simulation.film import Exposure
from graphvio.simulation.motion import Motion
from graphvio.simulation.world import World


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
