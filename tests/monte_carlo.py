"""Monte Carlo campaigns on the covariance of a motion: geometry of the simulator's scenes, random noise.

No images are made. Rays of random pixels of the rig's left cameras, at poses of a scene's walk, end on the scene's
surfaces; the points are projected through the real lenses, and every image point gets noise of its own in pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy.stats import chi2

from graphvio.arrays import AnyArray, Bool, Float
from graphvio.backend.smoother import Smoother
from graphvio.backend.states import InitialUncertainty, RigState
from graphvio.config.stages import MotionConfig, SmootherConfig
from graphvio.frontend.depth.stereo import triangulate
from graphvio.frontend.motion.observations import Observations, RigArrays
from graphvio.frontend.motion.refinement import Refined
from graphvio.frontend.motion.selection import searched_and_refined
from graphvio.geometry import se3_adjoint, se3_exp, se3_inverse, se3_log
from graphvio.measurements.motion import RelativeMotion
from graphvio.rig import Rig, StereoPair
from graphvio.simulation import build_scene
from graphvio.simulation.default_rig import default_rig
from graphvio.simulation.motion import Motion
from graphvio.simulation.raycast import TILE_PX, first_hits, ray_coefficients, tile_lists

RATE_HZ = 20.0
_MIN_DEPTH_M = 0.3
_MARGIN_PX = 2.0
_TRIES = 40
_PREDICTION_SIGMA = np.repeat([0.003, 0.01], 3)  # of the initial motion: rad, metres

Choice = Callable[[Float, Float], Bool]
"""Takes pixels (N, 2) in the left image and points (N, 3) in its camera's frame; says which take part (N,)."""


@dataclass(frozen=True, eq=False)
class Walk:
    """The static surfaces of a scene, (Q, 3, 3) as `ray_coefficients` takes them, and the walk through it."""

    corners: Float
    motion: Motion


@cache
def walk_through(scene: str) -> Walk:
    """The walk of a scene by its name."""
    built = build_scene(scene)
    return Walk(np.array([[r.origin, r.edge_u, r.edge_v] for r in built.world.rectangles]), built.motion)


@dataclass(frozen=True)
class Conditions:
    """Conditions under which frames are sampled.

    Attributes:
        scene: name of the simulator's scene.
        per_pair: points of each pair.
        noise_px: true standard deviation of an image point's coordinates.
        depth_scale: factor on the distance of every surface from the reference camera.
        min_depth_m: nearer points take no part.
        outlier_share: share of the tracks that are wrong at the current instant.
        outlier_px: by so much, in a random direction, in both images alike or in one of them.
        has_right: whether the current right images are seen.
        choice: which points may take part; None for all.
    """

    scene: str = "room"
    per_pair: tuple[int, ...] = (150, 150)
    noise_px: float = 0.3
    depth_scale: float = 1.0
    min_depth_m: float = _MIN_DEPTH_M
    outlier_share: float = 0.0
    outlier_px: float = 5.0
    has_right: bool = True
    choice: Choice | None = None


@dataclass(frozen=True, eq=False)
class Tracks:
    """True points of all pairs: pair (N,) and points (N, 3) in frame world, sorted by pair."""

    pair: AnyArray
    points: Float


@dataclass(frozen=True, eq=False)
class Seen:
    """Noisy normalised coordinates (N, 2) of the tracks in the left and the right images of one instant."""

    left: Float
    right: Float


@dataclass(eq=False)
class Campaign:
    """Errors and covariances of many independent motions.

    Attributes:
        errors: (6,) each, tangent of `Refined.covariance`.
        covariances: (6, 6) each.
        inlier_shares: share of the points that the motion explains.
    """

    errors: list[Float] = field(default_factory=list)
    covariances: list[Float] = field(default_factory=list)
    inlier_shares: list[float] = field(default_factory=list)

    def add(self, true_cur_T_ref: Float, refined: Refined) -> None:
        """One more motion."""
        self.errors.append(error_of(refined.cur_T_ref, true_cur_T_ref))
        self.covariances.append(refined.covariance)
        self.inlier_shares.append(float(refined.inlier.mean()))

    def nees(self) -> Float:
        """Squared error of each motion in units of its covariance."""
        return np.array([e @ np.linalg.solve(c, e) for e, c in zip(self.errors, self.covariances, strict=True)])


def band(count: int, dimensions: int = 6, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band of the mean of ``count`` chi-square variables of so many dimensions."""
    tail = 0.5 * (1.0 - probability)
    low, high = chi2.ppf([tail, 1.0 - tail], dimensions * count) / count
    return float(low), float(high)


def error_of(estimate: Float, truth: Float) -> Float:
    """Error (6,) of a ``cur_T_ref``, in the body frame at the current instant.

    Refinement perturbs ``cur_T_ref`` on the left, which is the right of the ``ref_T_cur`` that a between factor takes.
    """
    return se3_log(estimate @ se3_inverse(truth))


@cache
def rig_of_walks() -> Rig:
    """The rig that is carried."""
    return default_rig()


@cache
def arrays_of_walks() -> RigArrays:
    """Its arrays."""
    return RigArrays.of(rig_of_walks())


def sample_poses(walk: Walk, frames: int, rng: np.random.Generator) -> Float:
    """Poses ``world_T_body`` (frames + 1, 4, 4) of successive framesets from a random time of the walk on."""
    interval = frames / RATE_HZ
    start = rng.uniform(1.5, walk.motion.duration_s - interval - 2.0)
    return walk.motion.at(start + np.arange(frames + 1) / RATE_HZ).world_T_body


def sample_tracks(walk: Walk, poses: Sequence[Float], conditions: Conditions, rng: np.random.Generator) -> Tracks:
    """True points that every camera of a pair sees from each of some poses; rays begin at the first of them."""
    pairs, points = [], []
    for j, (pair, wanted) in enumerate(zip(rig_of_walks().pairs, conditions.per_pair, strict=True)):
        found = np.zeros((0, 3))
        for _ in range(_TRIES):
            if len(found) >= wanted:
                break
            found = np.concatenate([found, _cast(walk, poses, pair, conditions, rng)])
        assert len(found) >= wanted, "the scene offers too few points from here"
        pairs.append(np.full(wanted, j, dtype=np.int64))
        points.append(found[:wanted])
    return Tracks(np.concatenate(pairs), np.concatenate(points))


def _cast(
    walk: Walk, poses: Sequence[Float], pair: StereoPair, conditions: Conditions, rng: np.random.Generator
) -> Float:
    """Those of some random points (M, 3), frame world, that may take part."""
    left = pair.left
    pixels = rng.uniform(_MARGIN_PX, np.array(left.size_px) - 1.0 - _MARGIN_PX, size=(TILE_PX**2, 2))
    rays, valid = left.unproject(pixels)
    world_T_left = poses[0] @ left.body_T_cam
    coefficients = ray_coefficients(walk.corners, se3_inverse(world_T_left))
    extent = np.array([[rays[:, 0].min(), rays[:, 0].max(), rays[:, 1].min(), rays[:, 1].max()]])
    block = np.ascontiguousarray(rays.reshape(TILE_PX, TILE_PX, 2))  # as if they were one tile of an image
    hit, inverse_depth = (
        found.ravel() for found in first_hits(coefficients[None], *tile_lists(coefficients, extent), block)
    )
    valid &= (hit >= 0) & (conditions.depth_scale > conditions.min_depth_m * inverse_depth)
    homogeneous = np.column_stack([rays, np.ones(len(rays))])
    points = homogeneous[valid] * (conditions.depth_scale / inverse_depth[valid, None])
    if conditions.choice is not None:
        points = points[conditions.choice(pixels[valid], points)]
    world = points @ world_T_left[:3, :3].T + world_T_left[:3, 3]
    for pose in poses:
        for camera in (pair.left, pair.right):
            world = world[camera.project(_moved(camera.cam_T_body @ se3_inverse(pose), world))[1]]
    return np.asarray(world)


def _moved(a_T_b: Float, points: Float) -> Float:
    return np.asarray(points @ a_T_b[:3, :3].T + a_T_b[:3, 3])


def see(tracks: Tracks, world_T_body: Float, conditions: Conditions, rng: np.random.Generator) -> Seen:
    """Both images of every track with new noise, which is sampled in pixels and passes back through the lens."""
    views = []
    for side in range(2):
        view = np.empty((len(tracks.pair), 2))
        for j, pair in enumerate(rig_of_walks().pairs):
            camera, rows = (pair.left, pair.right)[side], tracks.pair == j
            if rows.any():
                pixels, _ = camera.project(_moved(camera.cam_T_body @ se3_inverse(world_T_body), tracks.points[rows]))
                view[rows], valid = camera.unproject(pixels + conditions.noise_px * rng.standard_normal(pixels.shape))
                assert valid.all()
        views.append(view)
    return Seen(*views)


def sample_outliers(tracks: Tracks, conditions: Conditions, rng: np.random.Generator) -> Bool:
    """Which tracks (N,) are wrong."""
    return np.asarray(rng.random(len(tracks.pair)) < conditions.outlier_share)


def led_astray(tracks: Tracks, seen: Seen, wrong: Bool, conditions: Conditions, rng: np.random.Generator) -> Seen:
    """The same with outliers (N,) moved in a random direction: a third each in both images, the left, the right."""
    n = len(tracks.pair)
    where = rng.integers(0, 3, size=n)
    angle = rng.uniform(0.0, 2.0 * np.pi, size=n)
    focal = arrays_of_walks().focal_px[tracks.pair]
    step = conditions.outlier_px * np.column_stack([np.cos(angle), np.sin(angle)])
    in_left, in_right = wrong & (where != 2), wrong & (where != 1)
    return Seen(
        seen.left + np.where(in_left[:, None], step / focal[:, :1], 0.0),
        seen.right + np.where(in_right[:, None], step / focal[:, 1:], 0.0),
    )


def observe(tracks: Tracks, reference: Seen, current: Seen, has_right: bool = True) -> Observations:
    """Observations of tracks that are seen at two instants."""
    n = len(tracks.pair)
    points, covariances = np.zeros((n, 3)), np.zeros((n, 3, 3))
    focal = arrays_of_walks().focal_px
    for j, pair in enumerate(rig_of_walks().pairs):
        rows = tracks.pair == j
        points[rows], covariances[rows], _ = triangulate(
            np.ascontiguousarray(reference.left[rows]),
            np.ascontiguousarray(reference.right[rows]),
            pair.right_T_left,
            float(focal[j, 0]),
            float(focal[j, 1]),
        )
    return Observations(tracks.pair, points, covariances, current.left, current.right, np.full(n, has_right))


def solve(observations: Observations, true_cur_T_ref: Float, config: MotionConfig, rng: np.random.Generator) -> Refined:
    """The joint motion, from a prediction that is a little off."""
    off = se3_exp(_PREDICTION_SIGMA * rng.standard_normal(6))
    return searched_and_refined(
        arrays_of_walks(), observations, np.ascontiguousarray(off @ true_cur_T_ref), config, rng
    )


def motion_between(world_T_ref: Float, world_T_cur: Float) -> Float:
    """``cur_T_ref`` (4, 4) of two poses."""
    return np.ascontiguousarray(se3_inverse(world_T_cur) @ world_T_ref)


def sample_frame(conditions: Conditions, rng: np.random.Generator) -> tuple[Float, Observations]:
    """A true motion ``cur_T_ref`` over one to five framesets of the walk, and what is observed of it."""
    walk = walk_through(conditions.scene)
    poses = sample_poses(walk, int(rng.integers(1, 6)), rng)
    tracks = sample_tracks(walk, (poses[0], poses[-1]), conditions, rng)
    reference = see(tracks, poses[0], conditions, rng)
    wrong = sample_outliers(tracks, conditions, rng)
    current = led_astray(tracks, see(tracks, poses[-1], conditions, rng), wrong, conditions, rng)
    return motion_between(poses[0], poses[-1]), observe(tracks, reference, current, conditions.has_right)


def run_campaign(conditions: Conditions, config: MotionConfig, frames: int, seed: int) -> Campaign:
    """Independent frames of a scene under some conditions."""
    campaign = Campaign()
    for number in range(frames):
        rng = np.random.default_rng([seed, number])
        truth, observations = sample_frame(conditions, rng)
        campaign.add(truth, solve(observations, truth, config, rng))
    return campaign


# ------------------------------------------------------------------ motions that share a reference, and chains of them


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Errors of two motions from one reference, over many samples of all noise with the same true points and poses.

    Attributes:
        first: (M, 6) errors of the first motion, in the body frame at the reference.
        second: (M, 6) of the second.
        refined: the first motion of each sample.
        true_cur_T_ref: of the first motion.
    """

    first: Float
    second: Float
    refined: list[Refined]
    true_cur_T_ref: Float

    def cross_covariance(self) -> Float:
        """Covariance (6, 6) between the two, made symmetric."""
        a, b = self.first - self.first.mean(axis=0), self.second - self.second.mean(axis=0)
        cross = a.T @ b / (len(a) - 1)
        return np.asarray(0.5 * (cross + cross.T))

    def covariance(self) -> Float:
        """Covariance (6, 6) of the first."""
        return np.asarray(np.cov(self.first.T))


def at_reference(cur_T_ref: Float, covariance: Float) -> Float:
    """A covariance (6, 6) of the body frame at the current instant in the one at the reference."""
    adjoint = se3_adjoint(se3_inverse(cur_T_ref))
    return np.asarray(adjoint @ covariance @ adjoint.T)


def sample_shared(
    conditions: Conditions, config: MotionConfig, frames: tuple[int, int], samples: int, seed: int
) -> SharedErrors:
    """Motions from one reference to two frames after it; the reference's noise and which tracks go wrong are shared."""
    rng = np.random.default_rng(seed)
    walk = walk_through(conditions.scene)
    all_poses = sample_poses(walk, max(frames), rng)
    poses = [all_poses[0], *(all_poses[k] for k in frames)]
    tracks = sample_tracks(walk, poses, conditions, rng)
    truths = [motion_between(poses[0], pose) for pose in poses[1:]]
    errors: list[list[Float]] = [[], []]
    refined: list[Refined] = []
    for _ in range(samples):
        reference = see(tracks, poses[0], conditions, rng)
        wrong = sample_outliers(tracks, conditions, rng)
        for k, truth in enumerate(truths):
            current = led_astray(tracks, see(tracks, poses[k + 1], conditions, rng), wrong, conditions, rng)
            motion = solve(observe(tracks, reference, current), truth, config, rng)
            errors[k].append(se3_adjoint(se3_inverse(truth)) @ error_of(motion.cur_T_ref, truth))
            if k == 0:
                refined.append(motion)
    return SharedErrors(np.array(errors[0]), np.array(errors[1]), refined, truths[0])


FIRST, FRAMES, KEYFRAME = 2, 20, 5  # a pose is composed from the first frameset over so many, between no two keyframes
_ANY_MOTION = SmootherConfig(lag_s=10.0, motion_accel_sigma_m_s2=1e3, motion_angular_accel_sigma_rad_s2=1e3)


@cache
def chain_of_motions(
    conditions: Conditions, config: MotionConfig, seed: int, number: int, new_tracks: bool
) -> tuple[Float, list[RelativeMotion]]:
    """True poses (N, 4, 4) of a part of the walk, and the motions of every frameset since its keyframe."""
    rng, walk, last = np.random.default_rng([seed, number]), walk_through(conditions.scene), FIRST + FRAMES
    poses, motions = sample_poses(walk, last, rng), list[RelativeMotion]()
    for key in range(0, last, KEYFRAME):
        to = min(key + KEYFRAME, last)
        if new_tracks or key == 0:
            tracks = sample_tracks(walk, list(poses[key : to + 1] if new_tracks else poses), conditions, rng)
            current = see(tracks, poses[key], conditions, rng)
        reference = current
        for k in range(key + 1, to + 1):
            current = see(tracks, poses[k], conditions, rng)
            refined = solve(observe(tracks, reference, current), motion_between(poses[key], poses[k]), config, rng)
            motions.append(
                RelativeMotion(
                    _stamp_ns(key), _stamp_ns(k), se3_inverse(refined.cur_T_ref), refined.covariance,
                    refined.shared_covariance, int(refined.inlier.sum()),
                )
            )  # fmt: skip
    return poses, motions


def _stamp_ns(frameset: int) -> int:
    return round(frameset * 1e9 / RATE_HZ)


def run_smoothed(
    conditions: Conditions, config: MotionConfig, chains: int, seed: int, *, new_tracks: bool, split: bool = True
) -> Campaign:
    """Poses composed by the smoother, vision alone, from the motions of every frameset since its keyframe.

    Args:
        conditions: without outliers.
        config: of the motions.
        chains: how many poses.
        seed: of all random values.
        new_tracks: each keyframe has tracks and views of its own; else the same tracks go on through all keyframes, and
            the noise of a keyframe's images is in the motion to it and in the ones from it.
        split: whether the smoother gets the covariance that motions from one keyframe share.
    """
    campaign, first_ns, last_ns = Campaign(), _stamp_ns(FIRST), _stamp_ns(FIRST + FRAMES)
    for number in range(chains):
        poses, motions = chain_of_motions(conditions, config, seed, number, new_tracks)
        smoother = Smoother(_ANY_MOTION, None)
        start = RigState(poses[0], np.zeros(3), np.zeros(3), np.zeros(3))
        smoother.initialise(0, start, InitialUncertainty(1e-8 * np.eye(6), 1.0, 1.0))
        for k, motion in enumerate(motions, start=1):
            smoother.extend(motion.stamp_ns, None)
            smoother.add_motion(motion if split else replace(motion, shared_covariance=np.zeros((6, 6))))
            smoother.update({_stamp_ns(k // KEYFRAME * KEYFRAME), first_ns})
        estimate = motion_between(smoother.pose(first_ns), smoother.pose(last_ns))
        campaign.errors.append(error_of(estimate, motion_between(poses[FIRST], poses[-1])))
        campaign.covariances.append(smoother.covariance_since(first_ns))
    return campaign
