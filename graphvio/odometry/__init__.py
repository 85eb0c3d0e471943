"""The odometry: measurements of the sensors in, estimates out."""

from graphvio.odometry.odometry import Odometry

__all__ = ["Odometry"]
