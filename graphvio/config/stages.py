"""The settings of each stage, with default values that need no tuning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from graphvio.config.values import StageConfig


@dataclass(frozen=True)
class CornerConfig(StageConfig):
    """Detection of Harris corners: one in each cell of the left image that has no track (section 3)."""

    cells_across: int = 18
    """Number of square cells across the width of an image of any size. Each cell gets at most one new corner."""
    min_response: float = 4.0
    """Smallest rms gradient along a corner's weaker direction, grey levels per pixel."""
    scarce_share: float = 0.33
    """If less than this share of the cells hold a track with depth, corners are detected in every frame, not only at
    keyframes. If the share is too small even with the new corners, weaker ones are accepted, see ``noise_factor``."""
    noise_factor: float = 1.5
    """Smallest rms gradient of a corner where corners are scarce, as a multiple of the standard deviation of the
    image's noise."""
    border_px: int = 9
    """Corners and tracks that are nearer to the image's edge than this are dropped."""

    def cell_px(self, width_px: int) -> int:
        """Return the side of a cell, pixels, in an image of the given width, pixels."""
        return max(round(width_px / self.cells_across), 1)


@dataclass(frozen=True)
class TrackingConfig(StageConfig):
    """Temporal 2D-2D matching by Lucas-Kanade (section 3).

    A track's patch in the keyframe is registered with the new image at the track's predicted position. Where that
    fails, the track is followed from the previous frame through image pyramids.
    """

    window_px: int = 15
    """Side of the patches that are compared, odd (an even value counts as the next odd one). It is that of Lucas-Kanade
    tracking, of the registration on the keyframe and of stereo alignment."""
    levels: int = 4
    """Number of pyramid levels, each of half the size of the one before."""
    max_forward_backward_px: float = 0.7
    """Largest distance of a corner from its original position after it was tracked forth and back: between the previous
    frame and the newest one, and between left and right image in stereo."""


@dataclass(frozen=True)
class StereoConfig(StageConfig):
    """Left-right matching under the epipolar and disparity constraints, and triangulation (section 3)."""

    min_depth_m: float = 0.3
    """Smallest depth at which a match is searched for; there is no largest depth."""
    max_epipolar_px: float = 1.0
    """Largest reprojection error of the triangulated point, over both images together. It measures the distance of a
    match from the epipolar line."""
    min_correlation: float = 0.7
    """Smallest normalised cross-correlation of the patches in the left and right image."""


@dataclass(frozen=True)
class MotionConfig(StageConfig):
    """Motion estimation: robust resection and refinement, by the best pair or by all pairs (sections 3 and 3.1)."""

    selection: Literal["best_pair", "joint"] = "joint"
    """``best_pair``: a motion is estimated by each pair alone, and that with the least global cost is used, eq. (4).
    ``joint``: one motion is estimated from all pairs together, section 3.1."""
    reference: Literal["previous", "keyframe"] = "keyframe"
    """The frameset from which motion is measured. ``previous``: the previous one. ``keyframe``: a keyframe, which stays
    the reference while enough of its points are in view."""
    keyframe_overlap: float = 0.7
    """A new keyframe is made where less than this share of the keyframe's points with depth are inliers of the motion.
    For other criteria see ``ReferenceThresholds`` in ``graphvio.frontend.thresholds``."""
    hypotheses: int = 500
    """Maximum number of 3-point hypotheses from each pair."""
    confidence: float = 0.99999
    """Confidence of RANSAC: sampling ends once, with this probability, at least one sampled triple consists of inliers
    only. With 1, all ``hypotheses`` are always sampled."""
    chunk_points: int = 100
    """Number of points of each pair on which hypotheses are scored before the worse half of them is dropped."""
    cauchy_scale_px: float = 1.5
    """Scale ``a`` of the robust (Cauchy) cost, eq. (2), in pixels, for the modelled noise. The refinement lowers it
    where residuals are smaller."""
    residuals: Literal["per_point", "per_image"] = "per_point"
    """Residuals to which the refinement's robust cost is applied. ``per_point``: the error of a point in both images,
    weighted by the noise of its pixels and of its triangulation. ``per_image``: the error in each image by itself, eq.
    (2)."""
    pixel_sigma_px: float = 0.3
    """Standard deviation of a tracked corner's position in one image."""
    max_error_px: float = 3.0
    """Largest reprojection error of an inlier."""
    sigma_inflation: float = 1.2
    """Factor on the standard deviations of an estimated motion. It accounts for errors that residuals do not show, such
    as those of matches that share a patch."""
    shared_error_share: float = 0.0002
    """Standard deviation of the error that all points of a motion have in common, as a share of the motion's angle and
    length. Residuals do not show this error. Used only with an IMU."""
    calibration_error_share: float = 0.002
    """The same as ``shared_error_share`` for errors of the rig file. It is added in quadrature where the calibration is
    not estimated during the run."""
    min_inliers: int = 12
    """Minimum number of inliers; motions with fewer are rejected."""
    min_inlier_share: float = 0.3
    """Minimum share of the points that are inliers; motions with a smaller share are rejected."""
    seed: int = 0
    """Seed of the random triples: equal seeds give equal results, to the bit."""


@dataclass(frozen=True)
class CalibrationConfig(StageConfig):
    """Estimation of the rig's calibration during the run."""

    online: bool = True
    """Whether the calibration is estimated and corrected during the run; needs ``motion.reference: keyframe``.
    Otherwise the calibration of the rig file is used as it is, and only a wrong transform between pairs is
    corrected."""


@dataclass(frozen=True)
class InitialisationConfig(StageConfig):
    """Initialisation of the state: roll and pitch from the accelerometer, at a standstill or in motion."""

    window_s: float = 1.0
    """IMU samples of this time before the first frameset are used."""
    min_window_s: float = 0.5
    """Shortest time that IMU samples must cover for the initialisation. Where those before the first frameset cover
    less, the frameset is held until they cover it together with later ones."""
    static_gyro_rad_s: float = 0.02
    """Largest standard deviation of the angular rate that counts as stationary."""
    static_accel_m_s2: float = 0.15
    """Largest standard deviation of the specific force that counts as stationary."""
    tilt_sigma_deg: float = 3.0
    """After an initialisation in motion, estimates have the status ``initialising`` until the standard deviations of
    roll and pitch are below this, and those of the velocity below ``velocity_sigma_m_s``."""
    velocity_sigma_m_s: float = 0.3
    """The limit on the standard deviation of the velocity in any direction, see ``tilt_sigma_deg``."""


@dataclass(frozen=True)
class SmootherConfig(StageConfig):
    """The fixed-lag smoother: its sliding window, its gate for vision and its limits (section 5)."""

    lag_s: float = 0.75
    """Length of the sliding window. Older states are marginalised when the window is next solved as a whole, up to two
    framesets later, unless later motions are measured from them. Not used for a rig of single cameras, whose window has
    up to 14 keyframes."""
    gate_probability: float = 0.9999
    """Vision is rejected where its innovation lies outside this share of the chi-square distribution. Without an IMU,
    the gate triples the standard deviations of the prediction, which assumes a constant velocity and measures
    nothing."""
    huber_probability: float = 1.0
    """Motions that passed the gate are down-weighted by Huber's kernel where their residual in the solution lies
    outside this share of the chi-square distribution. With 1, all are weighted by their covariance; below 1, the window
    is solved twice."""
    max_accel_m_s2: float = 50.0
    """Vision is rejected where it implies a larger acceleration."""
    max_gated_s: float = 1.0
    """Longest time for which the gate may reject vision. After that the prediction is taken to be wrong, and the state
    is reinitialised from vision."""
    reset_s: float = 60.0
    """Time from one reset of the position's covariance to the next."""
    imu_noise_scale: float = 3.0
    """Factor on the rig's IMU noise densities. Data sheets state them for a sensor that does not vibrate; real flights
    need the factor for a consistent covariance. Online, where the samples themselves show more noise than that, their
    noise is used."""
    motion_accel_sigma_m_s2: float = 5.0
    """Standard deviation of the acceleration, eq. (11). Used without an IMU, and for single cameras where IMU samples
    are missing."""
    motion_angular_accel_sigma_rad_s2: float = 10.0
    """Standard deviation of the angular acceleration, eq. (11), used as ``motion_accel_sigma_m_s2``."""
    lost_position_sigma_m: float = 1.0
    """The status changes from ``coasting`` to ``lost`` when the position's standard deviation has grown by more than
    this (as a root of the difference of variances) since vision last constrained it."""


@dataclass(frozen=True)
class FusionConfig(StageConfig):
    """Choice of the back-end, which fuses visual motions with the IMU."""

    estimator: Literal["smoother", "filter"] = "smoother"
    """``smoother``: the fixed-lag smoother. ``filter``: the paper's extended Kalman filter, as a baseline; it needs
    ``motion.reference: previous``, since it measures velocities over one step."""
    estimate_time_offset: bool = False
    """Whether the time offset between cameras and IMU is estimated from rotations and corrected during the run.
    Otherwise the offset of the rig file is used. Needs ``motion.reference: keyframe``."""


@dataclass(frozen=True)
class FilterConfig(StageConfig):
    """The paper's extended Kalman filter (section 5), used if ``fusion.estimator`` is ``filter``."""

    accel_sigma_m_s2: float = 5.0
    """Standard deviation of the acceleration within a step, eq. (11)."""
    angular_accel_sigma_rad_s2: float = 10.0
    """Standard deviation of the angular acceleration within a step, eq. (11)."""
    gyro_bias_walk_rad_s: float = 1e-4
    """Random walk of the gyro bias, rad/s/sqrt(s), which is rad/s^2/sqrt(Hz): the standard deviation of its change in
    one second, eq. (11)."""
    gyro_sigma_rad_s: float = 0.02
    """Standard deviation of the gyro's mean rate over a step. It is much larger than that of vision when vision's poses
    are good."""
    gravity_sigma_m_s2: float = 10.0
    """Standard deviation of the accelerometer as a measurement of gravity. It is large, since it includes the rig's own
    acceleration, which is correlated over several steps."""
    gate_probability: float = 0.9999
    """A measurement is rejected where its innovation lies outside this share of the chi-square distribution."""
    max_accel_m_s2: float = 30.0
    """Vision is rejected where it implies a larger acceleration."""
    max_gated_s: float = 1.0
    """Longest time for which vision may be rejected. After that the velocities are reinitialised as unknown."""
    reset_s: float = 10.0
    """Time from one reset of the position's covariance to the next."""
    bias: Literal["estimated", "none"] = "estimated"
    """``estimated``: the gyro bias is in the state. ``none``: the paper's first approach, without it; the gyro is used
    only where vision is missing, or differs from it by more than ``gyro_threshold_rad_s``."""
    gyro_threshold_rad_s: float = 0.1
    """With ``bias: none``: largest difference of gyro and vision, in each axis, up to which vision alone is used."""


@dataclass(frozen=True)
class TimingConfig(StageConfig):
    """Waiting times, and the tolerances of stamps and gaps."""

    simultaneous_ms: float | None = None
    """Largest difference between the stamps of images that are taken to be of the same instant. If unset, it is 2 ms;
    for left and right images of a recorded pair, it is a third of the median period, since stamps of arrival differ
    although both images were triggered together."""
    max_imu_wait_ms: float = 100.0
    """A frameset whose IMU samples are missing is held until a measurement arrives that is newer by this much."""
    max_imu_gap_ms: float = 50.0
    """Longest gap between IMU samples that is integrated over. With single cameras, gaps of up to 5 s are bridged as
    motion that is not measured."""
    max_prediction_ms: float = 200.0
    """Poses are predicted for at most this time after the newest IMU sample, or without an IMU after the newest
    frameset."""
    max_imu_start_wait_s: float = 2.0
    """If no IMU sample has arrived for this long after the first frameset, the odometry begins without the IMU."""


@dataclass(frozen=True)
class OptimizationConfig(StageConfig):
    """Optimisation of whole sessions: states, places and loop closures."""

    keyframe_interval_s: float = 0.2
    """Longest time between two consecutive states of the graph. All keyframes are states."""
    place_distance_m: float = 0.4
    """Smallest distance from the previous place at which a keyframe becomes a place. Places are compared with each
    other to find loop closures."""
    place_angle_deg: float = 15.0
    """Smallest rotation from the previous place at which a keyframe becomes a place, at any distance."""
    features: int = 1000
    """Number of SIFT features of a place's left image; the largest are used."""
    loop_interval_s: float = 10.0
    """Places of one session that are closer in time than this are not compared."""
    loop_candidates: int = 3
    """Number of other places that each place is compared with: those that look most like it."""
    loop_min_inliers: int = 30
    """Minimum number of inlier points of a loop closure."""
    loop_probability: float = 0.999
    """A loop closure is rejected where its difference from the odometry, or from the solution with all others, lies
    outside this share of the chi-square distribution."""


@dataclass(frozen=True)
class KeyframesConfig(StageConfig):
    """Keyframes that a SLAM system receives, and the gate for its corrections; not used without a SLAM system."""

    descriptors: Literal["orb", "sift", "none"] = "orb"
    """Descriptors of the landmarks in the left images: ``orb`` (32 bytes), ``sift`` (128 bytes) or ``none``."""
    images: bool = False
    """Whether keyframes contain their images."""
    gate_probability: float = 0.999
    """A correction is rejected where its innovation lies outside this share of the chi-square distribution."""


@dataclass(frozen=True)
class LiveConfig(StageConfig):
    """Real-time operation on live sensors."""

    max_latency_ms: float = 100.0
    """Longest time from the arrival of a frameset's last image to its estimate. To stay below it, fewer corners are
    tracked, and where that is not enough framesets are skipped."""
    max_image_wait_ms: float = 50.0
    """Longest time that an image waits for the other image of its pair, and a pair for the other pairs."""
    stuck_s: float = 5.0
    """A stage that works on one item for longer is reported as stuck, and a sensor that has sent nothing for longer as
    silent."""
