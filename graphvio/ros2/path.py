"""Where the rig has been, in a bounded number of poses."""

from __future__ import annotations

from typing import Any


class ThinnedPath:
    """Poses of the whole way: where they become too many, every second one goes, and of those to come, too.

    Args:
        most: how many are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._poses: list[Any] = []
        self._newest: Any = None
        self._stride, self._count = 1, 0

    def add(self, pose: Any) -> None:
        """Go on to a pose."""
        self._newest = pose
        if self._count % self._stride == 0:
            self._poses.append(pose)
        self._count += 1
        if len(self._poses) >= self._most:
            self._poses = self._poses[::2]
            self._stride *= 2

    def clear(self) -> None:
        """Begin anew, in another frame."""
        self._poses, self._newest, self._stride, self._count = [], None, 1, 0

    def poses(self) -> list[Any]:
        """What is kept, and the newest."""
        if not self._poses or self._poses[-1] is self._newest:
            return list(self._poses)
        return [*self._poses, self._newest]
