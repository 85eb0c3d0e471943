"""A recording in memory: images, IMU and truth of a walk through a scene."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from graphvio.arrays import Float, Image, Int
from graphvio.errors import SourceError
from graphvio.events import FrameSet
from graphvio.rig import Imu, Rig
from graphvio.simulation.atlas import Atlas
from graphvio.simulation.default_rig import default_rig
from graphvio.simulation.film import Film
from graphvio.simulation.imu import ImuTrack, measure
from graphvio.simulation.renderer import CameraRays, View
from graphvio.simulation.scenes import build_scene
from graphvio.simulation.scenes.scene import Scene
from graphvio.simulation.surfaces import Stage, Surfaces
from graphvio.simulation.textures import standard_atlas

EPOCH_NS = 1_700_000_000_000_000_000
_SENSITIVITIES = (1.45, 1.50, 1.42, 1.47)  # no two cameras are equally bright


class Simulator:
    """A rig that is carried through a scene; everything is a function of its arguments, to the bit.

    Args:
        scene: where, and how it is walked.
        rig: cameras and IMU; None for the paper's. A rig without an IMU gets the default one.
        seed: of all noise and biases. World and walk do not depend on it.
        rate_hz: framesets per second.
        atlas: textures of the world; None for the standard ones.

    Raises:
        SourceError: if the rate is impossible.
    """

    def __init__(
        self,
        scene: Scene,
        rig: Rig | None = None,
        seed: int = 0,
        rate_hz: float = 20.0,
        atlas: Atlas | None = None,
    ) -> None:
        if not 0.1 <= rate_hz <= 200.0:
            raise SourceError(f"a rate of {rate_hz} Hz cannot be simulated; give 0.1 to 200 framesets per second")
        if seed < 0:
            raise SourceError(f"the seed {seed} is negative; give 0 or more")
        self.scene = scene
        self.rig = rig if rig is not None else default_rig()
        self.imu = self.rig.imu if self.rig.imu is not None else Imu()
        self.seed = seed
        self.rate_hz = rate_hz
        self._stage = Stage(scene.world, atlas if atlas is not None else standard_atlas())
        self._rays = [CameraRays(camera) for camera in self.rig.cameras]
        self.films = [Film(r, _SENSITIVITIES[i % 4]) for i, r in enumerate(self._rays)]

    @cached_property
    def stamps_ns(self) -> Int:
        """Stamps (N,) of the framesets."""
        count = int(np.floor(self.scene.motion.duration_s * self.rate_hz + 1e-9))
        return EPOCH_NS + np.round(np.arange(max(count, 1)) * (1e9 / self.rate_hz)).astype(np.int64)

    @cached_property
    def world_T_body(self) -> Float:
        """True poses (N, 4, 4) of the framesets."""
        return self.scene.motion.at(self._seconds(self.stamps_ns)).world_T_body

    @cached_property
    def imu_track(self) -> ImuTrack:
        """IMU samples from the first frameset to the last and beyond, with the truth at their stamps."""
        imu = self.imu
        count = int(np.floor(self.scene.motion.duration_s * imu.rate_hz + 1e-9)) + 1
        stamps_ns = EPOCH_NS + np.round(np.arange(count) * (1e9 / imu.rate_hz)).astype(np.int64)
        return measure(self.scene.motion, imu, self._seconds(stamps_ns), stamps_ns, self.seed)

    def surfaces(self, index: int) -> Surfaces:
        """The world at the time of a frameset."""
        return self._stage.at(float(self._seconds(self.stamps_ns[index])))

    def view(self, index: int, camera: int, surfaces: Surfaces | None = None) -> View:
        """Noise-free radiance and true depth of a frameset's image; cameras count as in ``rig.cameras``."""
        seen = surfaces if surfaces is not None else self.surfaces(index)
        world_T_cam = self.world_T_body[index] @ self.rig.cameras[camera].body_T_cam
        return self._rays[camera].render(seen, self._stage.atlas, world_T_cam)

    def image(self, index: int, camera: int, noisy: bool = True, surfaces: Surfaces | None = None) -> Image:
        """Grey image (H, W) of a frameset."""
        exposure = self.scene.exposure(float(self._seconds(self.stamps_ns[index])))
        noise = np.random.Generator(np.random.SFC64([self.seed, 2, camera, index])) if noisy else None
        return self.films[camera].expose(self.view(index, camera, surfaces).radiance, exposure, noise)

    def frameset(self, index: int, noisy: bool = True) -> FrameSet:
        """Images of all pairs at one instant."""
        surfaces = self.surfaces(index)
        images = [self.image(index, camera, noisy, surfaces) for camera in range(len(self.rig.cameras))]
        return FrameSet(
            int(self.stamps_ns[index]),
            {k: (images[2 * k], images[2 * k + 1]) for k in range(len(self.rig.pairs))},
        )

    @staticmethod
    def _seconds(stamps_ns: Int) -> Float:
        return np.asarray((stamps_ns - EPOCH_NS) * 1e-9)


def make_simulator(
    name: str, *, duration_s: float | None = None, seed: int = 0, rate_hz: float = 20.0, rest_s: float = 1.0
) -> Simulator:
    """A simulator of a scene by its name, with the paper's rig.

    Raises:
        SourceError: if there is no such scene, or a value is impossible.
    """
    return Simulator(build_scene(name, duration_s, rest_s), seed=seed, rate_hz=rate_hz)
