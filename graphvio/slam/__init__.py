"""The odometry as the front-end of a SLAM system, which gets keyframes from it and returns global corrections."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from graphvio.slam.front_end import FrontEnd

__all__ = ["FrontEnd"]


def __getattr__(name: str) -> object:
    # Loaded when it is first used: a client of an odometry in another process does not need this module.
    if name != "FrontEnd":
        raise AttributeError(f"module 'graphvio.slam' has no attribute {name!r}")
    from graphvio.slam.front_end import FrontEnd

    return FrontEnd
