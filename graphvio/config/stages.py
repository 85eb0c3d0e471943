"""Settings of each stage, with defaults that need no tuning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from graphvio.config.values import StageConfig


@dataclass(frozen=True)
class CornerConfig(StageConfig):
    """Harris corners, one in each cell of the left image that has no track (section 3)."""

    cells_across: int = 18
    """Square cells across an image's width, whatever its size: at most one new corner in each."""
    min_response: float = 4.0
    """Smallest rms gradient along a corner's weaker direction, grey levels per pixel."""
    scarce_share: float = 0.33
    """If fewer than this share of the cells hold a track with depth, corners are found in every frame, not only at
    keyframes; if it is still fewer with the new ones, corners down to ``noise_factor`` are accepted."""
    noise_factor: float = 1.5
    """Smallest rms gradient of a corner where they are scarce, as a multiple of the standard deviation of the image's
    noise."""
    border_px: int = 9
    """Corners and tracks nearer to the image's edge are dropped."""

    def cell_px(self, width_px: int) -> int:
        """Return the side of a cell, pixels, in an image of some width."""
        return max(round(width_px / self.cells_across), 1)


@dataclass(frozen=True)
class TrackingConfig(StageConfig):
    """Temporal 2D-2D matching by Lucas-Kanade (section 3).

    Each track is registered on the keyframe's patch at its predicted place, and followed through pyramids from the
    previous frame where that fails.
    """

    window_px: int = 15
    """Side of the patch that is compared, odd (an even one counts as the next); also of the patches of registration on
    the keyframe and of stereo alignment."""
    levels: int = 4
    """Pyramid levels, each of half the size."""
    max_forward_backward_px: float = 0.7
    """Largest distance from a corner after tracking forth and back: from the previous frame, and from left to right in
    stereo."""


@dataclass(frozen=True)
class StereoConfig(StageConfig):
    """Left-right matching under the epipolar and disparity constraints, and triangulation (section 3)."""

    min_depth_m: float = 0.3
    """Smallest depth that is searched; there is no largest."""
    max_epipolar_px: float = 1.0
    """Largest reprojection error of the triangulated point, over both images together: how far a match is off the
    epipolar line."""
    min_correlation: float = 0.7
    """Smallest normalised cross-correlation of the two patches."""


@dataclass(frozen=True)
class MotionConfig(StageConfig):
    """Robust resection and refinement, and the choice between pairs (section 3, 3.1)."""

    selection: Literal["best_pair", "joint"] = "joint"
    """``best_pair``: each pair alone, the least global cost wins, eq. (4). ``joint``: all pairs together, section
    3.1."""
    reference: Literal["previous", "keyframe"] = "keyframe"
    """Motion is measured from the previous frameset, or from one that stays while enough of it is in view."""
    keyframe_overlap: float = 0.7
    """A new keyframe begins where fewer than this share of the keyframe's points with depth are inliers of the motion;
    other criteria are in ``ReferenceThresholds``."""
    hypotheses: int = 500
    """Maximum number of 3-point hypotheses of each pair."""
    confidence: float = 0.99999
    """RANSAC's confidence: sampling ends once a triple of inliers is among the samples with this probability; 1 always
    samples all ``hypotheses``."""
    chunk_points: int = 100
    """Points of each pair on which the hypotheses are scored before half of them are dropped."""
    cauchy_scale_px: float = 1.5
    """Scale ``a`` of the robust cost, eq. (2), in pixels, for the modelled noise; the refinement shrinks it where
    residuals are smaller."""
    residuals: Literal["per_point", "per_image"] = "per_point"
    """What the refinement's robust cost is applied to. ``per_point``: the error of a point in both images, weighted by
    the noise of its pixels and of its triangulation. ``per_image``: the error in each image by itself, eq. (2)."""
    pixel_sigma_px: float = 0.3
    """Standard deviation of a tracked corner's position in one image."""
    max_error_px: float = 3.0
    """Reprojection error beyond which a point is no inlier."""
    sigma_inflation: float = 1.2
    """Factor on a motion's standard deviations, for errors that residuals do not show, such as those of matches that
    share a patch."""
    shared_error_share: float = 0.0002
    """Error of a motion that its points have in common, so that residuals do not show it: one standard deviation, as a
    share of the motion's angle and length. Only with an IMU."""
    calibration_error_share: float = 0.002
    """The same for errors of the rig file, where the calibration is not estimated during the run."""
    min_inliers: int = 12
    """Motions that explain fewer points are rejected."""
    min_inlier_share: float = 0.3
    """Motions that explain a smaller share of the points are rejected."""
    seed: int = 0
    """Of the random triples: equal seeds give equal results, to the bit."""


@dataclass(frozen=True)
class CalibrationConfig(StageConfig):
    """Estimation of the rig's calibration while it runs."""

    online: bool = True
    """Whether the calibration is estimated and corrected during the run, for which ``motion.reference`` must be
    ``keyframe``; else the rig file's is used as it is, and only a wrong transform between pairs is corrected."""


@dataclass(frozen=True)
class InitialisationConfig(StageConfig):
    """The first pose: tilt from the accelerometer, while stationary or in motion."""

    window_s: float = 1.0
    """Time before the first frameset whose IMU samples are used."""
    min_window_s: float = 0.5
    """Shortest time of IMU samples for the initialisation. Where there is less before the first frameset, it is held
    until there are samples of this time after it."""
    static_gyro_rad_s: float = 0.02
    """Largest standard deviation of the angular rate that counts as stationary."""
    static_accel_m_s2: float = 0.15
    """Largest standard deviation of the specific force that counts as stationary."""
    tilt_sigma_deg: float = 3.0
    """After an initialisation in motion, estimates are ``initialising`` until the standard deviations of roll and pitch
    are below this, and those of the velocity below ``velocity_sigma_m_s``."""
    velocity_sigma_m_s: float = 0.3
    """Standard deviation of each component of the velocity below which the initialisation ends, with
    ``tilt_sigma_deg``."""


@dataclass(frozen=True)
class SmootherConfig(StageConfig):
    """The fixed-lag window, its gate and its limits (section 5)."""

    lag_s: float = 0.75
    """Length of the sliding window. Older states are marginalised when the window is next solved as a whole, up to two
    framesets later, unless later motions are measured from them. Unused by a rig of single cameras, whose window has up
    to 14 keyframes."""
    gate_probability: float = 0.9999
    """Vision is rejected where its innovation lies outside this share of the chi-square distribution. Without an IMU,
    the sigmas of the prediction are three times as large for it: constant velocity is no measurement."""
    huber_probability: float = 1.0
    """Motions that passed the gate are down-weighted by Huber's kernel where the solution leaves them outside this
    share of the chi-square distribution; 1 weighs all by their covariance. Below 1 the window is solved twice."""
    max_accel_m_s2: float = 50.0
    """Vision is rejected where it implies a larger acceleration."""
    max_gated_s: float = 1.0
    """When the gate has rejected vision for longer, the prediction is at fault and is reinitialised."""
    reset_s: float = 60.0
    """Time from one reset of the position's covariance to the next."""
    imu_noise_scale: float = 3.0
    """Factor on the rig's IMU noise densities, which data sheets state for a sensor that does not vibrate: real flights
    need it for a consistent covariance. Online, where samples show more noise than that, theirs is used."""
    motion_accel_sigma_m_s2: float = 5.0
    """Without an IMU, and for single cameras where its samples are missing: standard deviation of the acceleration, eq.
    (11)."""
    motion_angular_accel_sigma_rad_s2: float = 10.0
    """The same of the angular acceleration, eq. (11)."""
    lost_position_sigma_m: float = 1.0
    """Coasting ends in ``lost`` when the position has become less certain than this since vision was last used."""


@dataclass(frozen=True)
class FusionConfig(StageConfig):
    """Choice of the back-end, which fuses motions and the IMU."""

    estimator: Literal["smoother", "filter"] = "smoother"
    """``smoother``: the fixed-lag window. ``filter``: the paper's filter, as a baseline; it needs ``motion.reference:
    previous``, since it measures velocities over one step."""
    estimate_time_offset: bool = False
    """Whether the time offset between cameras and IMU is estimated from rotations and corrected during the run; else
    the rig's is used. Needs ``motion.reference: keyframe``."""


@dataclass(frozen=True)
class FilterConfig(StageConfig):
    """The paper's extended Kalman filter (section 5), where ``fusion.estimator`` is ``filter``."""

    accel_sigma_m_s2: float = 5.0
    """Standard deviation of the acceleration within a step, eq. (11)."""
    angular_accel_sigma_rad_s2: float = 10.0
    """Standard deviation of the angular acceleration within a step, eq. (11)."""
    gyro_bias_walk_rad_s: float = 1e-4
    """Random walk of the gyro bias, rad/s/sqrt(s), which is rad/s^2/sqrt(Hz): standard deviation of its change in one
    second, eq. (11)."""
    gyro_sigma_rad_s: float = 0.02
    """Standard deviation of the gyro's mean rate over a step: much more than vision's when its poses are good."""
    gravity_sigma_m_s2: float = 10.0
    """Noise of the accelerometer as a measurement of gravity, one standard deviation. It includes the rig's own
    acceleration, which is correlated over several steps, so it is set large."""
    gate_probability: float = 0.9999
    """A measurement is rejected where its innovation lies outside this share of the chi-square distribution."""
    max_accel_m_s2: float = 30.0
    """Vision is rejected where it implies a larger acceleration."""
    max_gated_s: float = 1.0
    """When the gates have rejected vision for longer, the velocities are forgotten."""
    reset_s: float = 10.0
    """Time from one reset of the position's covariance to the next."""
    bias: Literal["estimated", "none"] = "estimated"
    """``none`` is the paper's first approach: no gyro bias in the state, and the gyro is used only where it differs
    from vision by more than ``gyro_threshold_rad_s``."""
    gyro_threshold_rad_s: float = 0.1
    """For the first approach: the largest difference, in each axis, at which vision alone is used."""


@dataclass(frozen=True)
class TimingConfig(StageConfig):
    """Times to wait, and gaps that are tolerated."""

    simultaneous_ms: float | None = None
    """Images whose stamps differ by no more are of the same instant. Unset, it is 2 ms, and for left and right of a
    pair in a recording a third of the median period: stamps of arrival differ though both were triggered together."""
    max_imu_wait_ms: float = 100.0
    """A frameset whose IMU samples are missing is held until a measurement arrives that is newer by this much."""
    max_imu_gap_ms: float = 50.0
    """A longer gap between IMU samples is not integrated over; single cameras bridge up to 5 s, as motion that is not
    measured."""
    max_prediction_ms: float = 200.0
    """Poses are predicted no later than this after the newest IMU sample, or without an IMU after the newest
    frameset."""
    max_imu_start_wait_s: float = 2.0
    """When no IMU sample has arrived for this long, the odometry begins without the IMU."""


@dataclass(frozen=True)
class OptimizationConfig(StageConfig):
    """Optimisation of whole sessions: states, places and loop closures."""

    keyframe_interval_s: float = 0.2
    """Longest time between two states of the graph; all keyframes are states."""
    place_distance_m: float = 0.4
    """Distance from the previous place that makes a keyframe a place. Places are compared for loop closures."""
    place_angle_deg: float = 15.0
    """Rotation from the previous place that also makes a keyframe a place."""
    features: int = 1000
    """SIFT features of a place's left image, the largest ones."""
    loop_interval_s: float = 10.0
    """Places of one session that are closer in time are not compared."""
    loop_candidates: int = 3
    """Number of places that each is compared with: those that look most alike."""
    loop_min_inliers: int = 30
    """Minimum number of points that a loop closure explains."""
    loop_probability: float = 0.999
    """A loop closure is rejected where its difference from all others lies outside this share of the chi-square
    distribution."""


@dataclass(frozen=True)
class KeyframesConfig(StageConfig):
    """Keyframes for a SLAM system, and the gate of its corrections; unused without one."""

    descriptors: Literal["orb", "sift", "none"] = "orb"
    """Of the landmarks in the left images: ``orb`` (32 bytes), ``sift`` (128 bytes) or ``none``."""
    images: bool = False
    """Whether keyframes carry their images."""
    gate_probability: float = 0.999
    """A correction is rejected where its innovation lies outside this share of the chi-square distribution."""


@dataclass(frozen=True)
class LiveConfig(StageConfig):
    """Real-time operation on live sensors."""

    max_latency_ms: float = 100.0
    """Time from the arrival of a frameset's last image to its estimate: before it is exceeded fewer corners are
    followed, and then framesets are skipped."""
    max_image_wait_ms: float = 50.0
    """Time that an image waits for its partner, and a pair for the others."""
    stuck_s: float = 5.0
    """A stage that works on one item for longer is stuck; sensors that sent nothing for longer are silent."""
