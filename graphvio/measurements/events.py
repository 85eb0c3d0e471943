"""Events of a run, such as rejected measurements, resets and faults of the input, and their kinds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

CORRECTED = "corrected for this run"
"""Suffix of sentences about errors of the rig file that are corrected in the run's results and ``rig-refined.yaml``."""


class EventKind(StrEnum):
    """Kinds of events; the sentence after each says what happened and what is done about it."""

    # ---------------------------------------------------------------- input of the odometry
    IMU_NOT_FINITE = "imu_not_finite"
    """An IMU sample has a NaN or infinite component; it is left out."""
    IMU_OUT_OF_RANGE = "imu_out_of_range"
    """An IMU sample is beyond what any inertial sensor measures; it is left out."""
    IMU_DUPLICATE_STAMP = "imu_duplicate_stamp"
    """An IMU sample has the stamp of the previous one; it is left out."""
    IMU_BACKWARD_STAMP = "imu_backward_stamp"
    """An IMU sample is older than the previous one; it is left out."""
    IMU_FUTURE_STAMP = "imu_future_stamp"
    """The stamp of an IMU sample is far ahead of its neighbours'; it is left out."""
    IMU_STUCK = "imu_stuck"
    """An axis of the IMU repeats its value beyond what noise allows; samples are left out until it changes again."""
    IMU_SPIKE = "imu_spike"
    """A single IMU sample is far from its neighbours; it is left out."""
    FRAMESET_DUPLICATE_STAMP = "frameset_duplicate_stamp"
    """A frameset comes less than 1 ms after the previous one; it is left out."""
    FRAMESET_BACKWARD_STAMP = "frameset_backward_stamp"
    """A frameset is older than the previous one; it is left out."""
    FRAMESET_FUTURE_STAMP = "frameset_future_stamp"
    """The stamp of a frameset is far ahead of its neighbours'; it is left out."""
    UNKNOWN_PAIR = "unknown_pair"
    """A frameset has images of a pair that is not in the rig; they are left out."""
    IMU_NOT_COVERING = "imu_not_covering"
    """No IMU samples cover the interval between two framesets; the motion is predicted without them."""
    IMU_LEFT_OUT = "imu_left_out"
    """The IMU contradicts good vision for long; it is left out until its motion agrees with vision again."""
    IMU_USED_AGAIN = "imu_used_again"
    """The motion of an IMU that was left out agrees with vision again; the IMU is used again."""
    IMU_CLOCK_OFF = "imu_clock_off"
    """The IMU's motion agrees with vision, but its stamps are early or late; they are corrected if possible."""
    STARTED_WITHOUT_IMU = "started_without_imu"
    """No IMU samples came while the odometry waited for them; it is initialised without the IMU."""
    IMU_CAME = "imu_came"
    """IMU samples came after a start without them. The trajectory continues; the paper's filter begins a new epoch."""

    # ---------------------------------------------------------------- vision
    VISION_FAILED = "vision_failed"
    """The front-end has no motion: too few points, or none that enough of them agree on."""
    VISION_WEAK = "vision_weak"
    """A motion is uncertain beyond what its residuals show; its covariance is enlarged."""
    CAMERA_FROZEN = "camera_frozen"
    """A camera repeats its image while others do not; its pair is left out until the image changes."""
    PAIR_UNUSED = "pair_unused"
    """A stereo pair contributes to no motion for 5 s, while other cameras do; check its images and its calibration."""
    RIG_MISTAKEN = "rig_mistaken"
    """A pair's images match only if left and right are exchanged, or if its cameras' transforms are inverted."""
    CALIBRATION_CORRECTED = "calibration_corrected"
    """A part of the rig file is wrong beyond 5 sigma by two windows of keyframes; it is corrected from now on."""
    CALIBRATION_CHANGED = "calibration_changed"
    """The images contradict the estimated calibration for some time, as after a knock; it is estimated again."""
    CALIBRATION_REFUSED = "calibration_refused"
    """Two windows of keyframes each imply an implausibly large error of the rig file, and disagree on it, or the error
    is one of the IMU. It is not corrected, and poses are worse than their covariance: calibrate again."""
    EXTRINSICS_OFF = "extrinsics_off"
    """The pairs' motions contradict the rig's transform between them; it is corrected for this run. Or the scale of
    single cameras' overlapping views contradicts the accelerometer; overlaps are not used from then on."""

    # ---------------------------------------------------------------- state estimation
    VISION_GATED = "vision_gated"
    """A measured motion failed the innovation test, or implies an impossible acceleration; it is left out."""
    GYRO_GATED = "gyro_gated"
    """The mean angular rate failed the paper's filter's innovation test; it is left out."""
    ACCELEROMETER_GATED = "accelerometer_gated"
    """The mean specific force failed the paper's filter's innovation test; it is left out."""
    ZERO_VELOCITY_GATED = "zero_velocity_gated"
    """Images and IMU show a standstill, but the state is certain of a motion; the zero-velocity update is left out."""
    MOTION_OVER_SEVERAL_STEPS = "motion_over_several_steps"
    """A motion does not start at the previous frameset, so that the paper's filter cannot use it; it is left out."""
    GATE_RESET = "gate_reset"
    """The gate rejected vision for too long: the smoother is reinitialised from vision, the filter's velocities are
    reset. Or the IMU's calibration proves wrong while vision is rejected, or good images are rejected after a gap that
    the IMU alone has bridged: the smoother is reinitialised from vision. Or the motion to the keyframe was rejected,
    and the next motion passes: the smoother is reinitialised at the prediction, with the difference as uncertainty."""
    SCALE_KNOWN = "scale_known"
    """A rig of single cameras has moved so that the scale is known; poses are estimated from now on."""
    LOST = "lost"
    """The position is too uncertain to be reported."""
    NEW_EPOCH = "new_epoch"
    """Vision is back after the estimate was lost; a new epoch begins at the predicted pose."""
    TIME_JUMP = "time_jump"
    """Neither images nor IMU bridge a gap of time; a new epoch begins at the last pose."""
    WINDOW_REBUILT = "window_rebuilt"
    """The smoother's equations have no unique solution; its window is rebuilt around the newest state."""
    NOT_INITIALISED = "not_initialised"
    """Some seconds after a start in motion, attitude or velocity are still uncertain; go on moving."""
    TIME_OFFSET_OFF = "time_offset_off"
    """Rotations by vision and gyro contradict the rig's time offset, or the stamps of a pair that is triggered by
    itself; it is corrected for this run."""

    # ---------------------------------------------------------------- SLAM
    CORRECTION_REFUSED = "correction_refused"
    """A SLAM system's correction of a keyframe failed the innovation test, or is of another epoch; it is left out."""
    MAP_MOVED = "map_moved"
    """Several corrections that had been refused agree with each other; the map frame follows them."""

    # ---------------------------------------------------------------- recordings
    SESSION_CUT = "session_cut"
    """The recording of a session was not finished; its readable part is used."""
    SESSION_DAMAGED = "session_damaged"
    """Parts of a session cannot be read; the other parts are used."""
    IMU_GARBAGE = "imu_garbage"
    """A row or message of the IMU is not valid; it is dropped."""
    IMU_UNITS = "imu_units"
    """The accelerometer's readings are far from gravity, as if they were in g; they are used as they are."""
    FRAME_GARBAGE = "frame_garbage"
    """A row or message of a camera is not valid; it is dropped."""
    IMU_DUPLICATE = "imu_duplicate"
    """An IMU row has the stamp of an earlier one; it is dropped."""
    FRAME_DUPLICATE = "frame_duplicate"
    """A camera's row has the stamp of an earlier one; it is dropped."""
    IMU_BACKWARD = "imu_backward"
    """An IMU row is out of order; it is dropped."""
    FRAME_BACKWARD = "frame_backward"
    """A camera's row is out of order; it is dropped."""
    IMU_OUTLIER = "imu_outlier"
    """The stamp of an IMU row lies an hour or more from all others; it is dropped."""
    FRAME_OUTLIER = "frame_outlier"
    """The stamp of a camera's row lies an hour or more from all others; it is dropped."""
    IMU_GAP = "imu_gap"
    """There is no IMU sample for more than five periods; framesets in the gap do not wait for any."""
    FRAME_GAP = "frame_gap"
    """A pair has no images for more than 1.5 periods."""
    IMU_BEGINS_LATE = "imu_begins_late"
    """The IMU does not cover the first frameset."""
    IMU_STOPS_EARLY = "imu_stops_early"
    """The IMU does not cover the last frameset."""
    IMU_SEVERAL = "imu_several"
    """Several topics have IMU samples; the first by name is used, unless ``--topics imu=TOPIC`` names another."""
    IMU_MISSING = "imu_missing"
    """The rig has an IMU, but the recording has no samples of it; vision alone is used."""
    UNPAIRED_IMAGE = "unpaired_image"
    """A left image has no right one within the tolerance, or the other way round; it is dropped."""
    PAIRING_AMBIGUOUS = "pairing_ambiguous"
    """A left image has several right ones within the tolerance, or the other way round; the nearest are taken."""
    FRAMESET_INCOMPLETE = "frameset_incomplete"
    """A pair has no images at a time when another pair has; the others are used."""
    FRAMESET_EMPTY = "frameset_empty"
    """No pair has two usable images; the frameset is dropped."""
    IMAGE_MISSING = "image_missing"
    """The file of an image does not exist; its pair is left out of the frameset."""
    IMAGE_UNDECODABLE = "image_undecodable"
    """An image is empty, cut or damaged; its pair is left out of the frameset."""
    IMAGE_WRONG_SIZE = "image_wrong_size"
    """An image is not of the rig's size; its pair is left out of the frameset."""
    MASK_MISSING = "mask_missing"
    """A camera has masks, but none of an image, or a damaged one; all of the image is used."""
    CSV_MISSING = "csv_missing"
    """A camera has no ``data.csv``; stamps are read from the names of its images."""

    # ---------------------------------------------------------------- live
    DEVICE_LOST = "device_lost"
    """A device was unplugged or fell silent."""
    DEVICE_BACK = "device_back"
    """A device delivers again."""
    IMU_NO_TRANSFORM = "imu_no_transform"
    """No transform leads from body to the frame of the IMU samples of a ROS 2 topic; they are left out."""
    IMU_LEVER_ARM = "imu_lever_arm"
    """The frame of the IMU samples of a ROS 2 topic is not at body; they are rotated only."""
    CAMERAS_SILENT = "cameras_silent"
    """No image has come for ``live.stuck_s``."""
    CAMERAS_BACK = "cameras_back"
    """Images come again."""
    IMU_SILENT = "imu_silent"
    """No IMU sample has come for ``live.stuck_s``."""
    IMU_BACK = "imu_back"
    """IMU samples come again."""
    STAGE_STUCK = "stage_stuck"
    """A stage works on one item for longer than ``live.stuck_s``, or did not end."""
    STAGE_RECOVERED = "stage_recovered"
    """A stage that was stuck goes on."""
    STAGE_FAILED = "stage_failed"
    """An error ended a stage, and with it the run."""
    IMAGE_DAMAGED = "image_damaged"
    """An image could not be decoded; it is left out."""
    CLOCK_RESTARTED = "clock_restarted"
    """A clock was set to another time; its mapping to the host's clock is initialised again."""
    CLOCK_STEPPED = "clock_stepped"
    """A clock went forward by less than 0.5 s; the mapping follows by 1 ms a second."""
    STAMP_IMPLAUSIBLE = "stamp_implausible"
    """A stamp is more than 0.5 s off its device's clock; it is left out until three in a row agree."""
    IMAGE_WITHOUT_PARTNER = "image_without_partner"
    """An image has no partner from the other camera of its pair; it is left out."""
    LATE_IMAGE = "late_image"
    """An image is of an instant whose frameset was handed on already; it is left out."""
    DUPLICATE_IMAGE = "duplicate_image"
    """An image has the stamp of an earlier one of its camera; it is left out."""
    IMAGE_FUTURE_STAMP = "image_future_stamp"
    """The stamp of an image is more than 5 s ahead; it is left out."""
    UNKNOWN_CAMERA = "unknown_camera"
    """An image is of a camera that is not in the rig; it is left out."""


@dataclass(frozen=True, slots=True)
class Event:
    """An event of a run: a measurement that was rejected, a reset, or a fault of the input.

    Attributes:
        stamp_ns: Time of the event, on the clock of the data concerned.
        kind: Kind of the event, see `EventKind`. Drivers of devices may have kinds of their own.
        detail: One line for people, with the figures.
    """

    stamp_ns: int
    kind: str
    detail: str


Report = Callable[[int, str, str], None]
"""Function that takes stamp, kind and detail of an event."""
