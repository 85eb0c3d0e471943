"""Estimation of the rig's calibration while it moves, from the tracks of its cameras and the IMU.

Windows of keyframes are adjusted with the calibration as unknowns, in a thread of its own. What each says of the
calibration is information that adds up from window to window; the rig file is corrected in the parts that it
contradicts beyond doubt. Begin to read at `online`.

*The calibration.* `parameters` lays it out as one vector, and applies a vector to a rig. `prior` is how far a rig file
is known; `imu_model` and `imu_correction` are the IMU's part.

*One window.* `collector` gathers keyframes and IMU samples until a window is full, and `window` chooses its landmarks.
`adjustment` solves it twice, without outliers the second time: `solver` has the Levenberg-Marquardt steps, `bundle` the
normal equations of the landmarks (`observation`, `moving_landmarks`, `pixel_noise`) and `inertial` those of the IMU
(`preintegration`, `preintegration_errors`). `inertial_state` is what it knows of velocity, biases and gravity.

*All windows.* `evidence` adds up what windows say, and estimates how wrong the rig file is; `window_adjustment` is one
window together with those before. `findings` compares the result with the rig file, part by part, `curves` shows it to
people, and `estimate` is all that is known at one moment. `knock` recognises a camera that was turned.

*Elsewhere.* `consider` and `motion_gains` add to the pose's covariance what errors of the calibration do to it, and
`innovation` to the innovation test. `batch` calibrates from a whole recording.
"""
