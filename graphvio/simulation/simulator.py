"""Simulated recordings in memory: images, IMU samples and truth of a motion through a scene."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache

import numpy as np

from graphvio.arrays import Float, Image, Int
from graphvio.errors import SourceError
from graphvio.measurements.sensors import FrameSet
from graphvio.rig import Imu, Rig
from graphvio.simulation.calibration_error import ImuError
from graphvio.simulation.imu import ImuTrack, measure
from graphvio.simulation.named_rigs import NAMED_RIGS
from graphvio.simulation.renderer import CameraRays, Film, RenderedView
from graphvio.simulation.rig_change import RigChange
from graphvio.simulation.scenes import build_scene
from graphvio.simulation.surfaces import PreparedWorld, Surfaces
from graphvio.simulation.textures import Atlas, standard_atlas
from graphvio.simulation.world import Scene

EPOCH_NS = 1_700_000_000_000_000_000
_SENSITIVITIES = (1.45, 1.50, 1.42, 1.47)  # no two cameras are equally bright
_KEPT_STAGES = 4  # stages of a changing rig whose rays are cached: about as many as threads render at once


class Simulator:
    """A rig that is carried through a scene; equal arguments give equal output, bit for bit.

    Args:
        scene: world, motion and light.
        rig: true cameras and IMU; None for the scene's own rig. For a rig without an IMU, the default IMU is simulated.
        seed: seed of all noise and biases. World and motion do not depend on it.
        rate_hz: framesets per second; or one rate for each pair and single camera, the last one also for all after it;
            None for the scene's own rate.
        atlas: textures of the world; None for the standard textures.
        trigger_offset_ms: delay of the triggers of each pair or single camera after those of the one before it.
        imu_error: scale and misalignment errors of the IMU, or None.
        rig_change: change of the true cameras during the motion; None for no change.

    Attributes:
        rates_hz: images per second of each pair and single camera.

    Raises:
        SourceError: if a rate or the offset is impossible.
    """

    def __init__(
        self,
        scene: Scene,
        rig: Rig | None = None,
        seed: int = 0,
        rate_hz: float | Sequence[float] | None = None,
        atlas: Atlas | None = None,
        trigger_offset_ms: float = 0.0,
        imu_error: ImuError | None = None,
        rig_change: RigChange | None = None,
    ) -> None:
        wanted = rate_hz if rate_hz is not None else scene.rate_hz
        rates = list(wanted) if isinstance(wanted, Sequence) else [wanted]
        for rate in rates:
            if not 0.1 <= rate <= 200.0:
                raise SourceError(f"a rate of {rate} Hz cannot be simulated; give 0.1 to 200 framesets per second")
        if not rates:
            raise SourceError("no rate is given; give 0.1 to 200 framesets per second")
        if not 0.0 <= trigger_offset_ms <= 1000.0:
            raise SourceError(f"a trigger offset of {trigger_offset_ms} ms cannot be simulated; give 0 to 1000")
        if seed < 0:
            raise SourceError(f"the seed {seed} is negative; give 0 or more")
        self.scene = scene
        self.rig = NAMED_RIGS[scene.rig]() if rig is None else rig.without_stamp_offsets()  # its stamps are instants
        self.imu = self.rig.imu if self.rig.imu is not None else Imu()
        self.seed = seed
        groups = len(self.rig.groups)
        self.rates_hz = tuple((rates + [rates[-1]] * groups)[:groups])
        self._trigger_offset_ms = trigger_offset_ms
        self._atlas = atlas
        self._imu_error, self._rig_change = imu_error, rig_change
        self._rays_in = lru_cache(_KEPT_STAGES)(self._rays_of)

    @cached_property
    def _prepared(self) -> PreparedWorld:
        """The world as the renderer's kernels read it; made at the first rendering, since it takes a second."""
        return PreparedWorld(self.scene.world, self._atlas if self._atlas is not None else standard_atlas())

    @cached_property
    def films(self) -> list[Film]:
        """The sensors of the cameras."""
        return [Film(rays, _SENSITIVITIES[i % 4]) for i, rays in enumerate(self._rays_in(0))]

    @cached_property
    def stamps_ns(self) -> Int:
        """Stamps (N,) of the framesets: all instants at which a pair or single camera is triggered."""
        return np.unique(np.concatenate([self.triggers_ns(group) for group in range(len(self.rig.groups))]))

    def cameras_of(self, group: int) -> range:
        """Return the indices in ``rig.cameras`` of a pair or single camera."""
        first = sum(len(each.cameras) for each in self.rig.groups[:group])
        return range(first, first + len(self.rig.groups[group].cameras))

    def triggers_ns(self, group: int) -> Int:
        """Return the stamps (M,) at which a pair or single camera takes images; readouts end within the motion."""
        readout_s = 1e-9 * max(camera.readout_ns for camera in self.rig.groups[group].cameras)
        rate, duration_s = self.rates_hz[group], self.scene.motion.duration_s - readout_s
        late_ns = round(group * self._trigger_offset_ms * 1e6)
        count = int(np.floor(duration_s * rate + 1e-9))
        since_ns = late_ns + np.round(np.arange(max(count, 1)) * (1e9 / rate)).astype(np.int64)
        return np.asarray(EPOCH_NS + since_ns[(since_ns <= round(duration_s * 1e9)) | (since_ns == 0)])

    def triggered(self, index: int) -> tuple[int, ...]:
        """Return the indices of the pairs and single cameras that take images at a frameset's stamp."""
        stamp = int(self.stamps_ns[index])
        return tuple(group for group, triggers in enumerate(self._triggers) if stamp in triggers)

    @cached_property
    def world_T_body(self) -> Float:
        """True poses (N, 4, 4) of the framesets."""
        return self.scene.motion.at(self._seconds(self.stamps_ns)).world_T_body

    @cached_property
    def imu_track(self) -> ImuTrack:
        """IMU samples over the whole motion, with the truth at their stamps."""
        imu = self.imu
        count = int(np.floor(self.scene.motion.duration_s * imu.rate_hz + 1e-9)) + 1
        stamps_ns = EPOCH_NS + np.round(np.arange(count) * (1e9 / imu.rate_hz)).astype(np.int64)
        return measure(self.scene.motion, imu, self._seconds(stamps_ns), stamps_ns, self.seed, self._imu_error)

    def rig_at(self, index: int) -> Rig:
        """Return the true rig at the time of a frameset."""
        return self._rig_in(self._rig_stage(index))

    def surfaces(self, index: int) -> Surfaces:
        """Return the surfaces of the world at the time of a frameset."""
        return self._prepared.at(float(self._seconds(self.stamps_ns[index])))

    def view(self, index: int, camera: int, surfaces: Surfaces | None = None) -> RenderedView:
        """Render the noise-free radiance and true depth of an image.

        Each line of a rolling shutter is rendered from the camera's pose at that line's instant. Moving parts of the
        world are the same for all lines.

        Args:
            index: index of the frameset.
            camera: index in ``rig.cameras``.
            surfaces: surfaces at the frameset's instant, if they have been computed already.
        """
        seen = surfaces if surfaces is not None else self.surfaces(index)
        rays = self._rays_in(self._rig_stage(index))[camera]
        world_T_body = self.world_T_body[index]
        if rays.camera.line_time_us:
            line_times_s = 1e-6 * rays.camera.line_time_us * np.arange(rays.camera.size_px[1])
            times_s = float(self._seconds(self.stamps_ns[index])) + line_times_s
            world_T_body = self.scene.motion.at(np.minimum(times_s, self.scene.motion.duration_s)).world_T_body
        return rays.render(seen, self._prepared.atlas, world_T_body @ rays.camera.body_T_cam)

    def image(self, index: int, camera: int, noisy: bool = True, surfaces: Surfaces | None = None) -> Image:
        """Render a grey image (H, W); see `view` for the arguments."""
        exposure = self.scene.exposure(float(self._seconds(self.stamps_ns[index])))
        noise = np.random.Generator(np.random.SFC64([self.seed, 2, camera, index])) if noisy else None
        return self.films[camera].expose(self.view(index, camera, surfaces).radiance, exposure, noise)

    def frameset(self, index: int, noisy: bool = True) -> FrameSet:
        """Render the images of the pairs and single cameras that are triggered at one instant."""
        surfaces = self.surfaces(index)
        images = {
            k: tuple(self.image(index, camera, noisy, surfaces) for camera in self.cameras_of(k))
            for k in self.triggered(index)
        }
        return FrameSet(int(self.stamps_ns[index]), images)

    def _rig_stage(self, index: int) -> int:
        if self._rig_change is None:
            return 0
        return self._rig_change.stage_at(float(self._seconds(self.stamps_ns[index])), self.scene.motion.duration_s)

    def _rig_in(self, stage: int) -> Rig:
        return self.rig if self._rig_change is None else self._rig_change.rig_in(self.rig, stage)

    def _rays_of(self, stage: int) -> list[CameraRays]:
        return [CameraRays(camera) for camera in self._rig_in(stage).cameras]

    @cached_property
    def _triggers(self) -> list[frozenset[int]]:
        return [frozenset(self.triggers_ns(group).tolist()) for group in range(len(self.rig.groups))]

    @staticmethod
    def _seconds(stamps_ns: Int) -> Float:
        return np.asarray((stamps_ns - EPOCH_NS) * 1e-9)


def make_simulator(
    name: str,
    *,
    duration_s: float | None = None,
    seed: int = 0,
    rate_hz: float | Sequence[float] | None = None,
    stationary_s: float = 1.0,
    trigger_offset_ms: float = 0.0,
    rig: Rig | None = None,
    imu_error: ImuError | None = None,
    rig_change: RigChange | None = None,
) -> Simulator:
    """Build a simulator of a scene by its name.

    Args:
        name: one of `graphvio.simulation.SCENE_NAMES`.
        duration_s: duration of the recording; None for the whole walk.
        seed: see `Simulator`.
        rate_hz: see `Simulator`.
        stationary_s: initial standstill; with 0 the recording begins at walking speed.
        trigger_offset_ms: see `Simulator`.
        rig: see `Simulator`.
        imu_error: see `Simulator`.
        rig_change: see `Simulator`.

    Raises:
        SourceError: if there is no such scene, or a value is impossible.
    """
    scene = build_scene(name, duration_s, stationary_s)
    return Simulator(
        scene,
        rig,
        seed,
        rate_hz,
        trigger_offset_ms=trigger_offset_ms,
        imu_error=imu_error,
        rig_change=rig_change,
    )
