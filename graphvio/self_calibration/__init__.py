"""Estimation of the rig's calibration while it moves, from the tracks of its cameras and the IMU.

Windows of keyframes are adjusted with the calibration as unknowns, in a thread of its own. Their evidence about the
calibration is added up from window to window; the rig file is corrected in the parts that it contradicts beyond doubt.
Start reading at `online`.

*The calibration.* `parameters` defines it as one vector, and applies such a vector to a rig. `prior` is the covariance
of a rig file's calibration; `imu_model` and `imu_correction` are the IMU's part.

*One window.* `collector` gathers keyframes and IMU samples until a window is full, and `window` chooses its landmarks.
`adjustment` solves it twice, without outliers the second time: `solver` has the Levenberg-Marquardt steps, `bundle` the
normal equations of the landmarks (`observation`, `moving_landmarks`, `pixel_noise`) and `inertial` those of the IMU
(`preintegration`, `preintegration_errors`). `inertial_state` takes velocity, biases and gravity from the solution.

*All windows.* `evidence` adds up the information of all windows, and estimates how wrong the rig file is;
`window_adjustment` adjusts one window, given those before. `findings` compares the result with the rig file, part by
part, `curves` prepares it for plots, and `estimate` holds all that is known at one moment. `knock` detects cameras
that were turned or moved.

*Elsewhere.* `consider` and `motion_gains` compute what errors of the calibration add to the pose's covariance, and
`innovation` what they add to that of the innovation test. `batch` calibrates from a whole recording.
"""
