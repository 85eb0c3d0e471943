"""The odometry as the front-end of a SLAM system: keyframes out, global corrections in."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from graphvio.slam.front_end import FrontEnd

__all__ = ["FrontEnd"]


def __getattr__(name: str) -> object:
    # Loaded when it is first used: a client of another process needs no odometry.
    if name != "FrontEnd":
        raise AttributeError(f"module 'graphvio.slam' has no attribute {name!r}")
    from graphvio.slam.front_end import FrontEnd

    return FrontEnd
