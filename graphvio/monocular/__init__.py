"""Odometry of single cameras and an IMU: a window of keyframes with landmarks, and scale from the accelerometer.

Without a stereo pair the front-end cannot measure a motion in metres. Landmarks, states, IMU biases and calibration are
therefore estimated together in one window, which is solved at each frameset. Start reading at `estimator`.

*The first window.* `initialiser` collects keyframes until the scale is known: `closed_form` guesses velocity, gravity
and depths, `adjustment` refines them, and `overlap_trust` checks the scale of overlapping views against the
accelerometer.

*The window.* `window` holds the states (`states`) and the views of landmarks from them (`sightings`); `sample_buffer`
holds the IMU samples in between. `window_solver` solves the window at a frameset. `equations` are its normal equations,
with the landmarks eliminated (`structure`, with the errors of `reprojection`); between keyframes, landmarks that the
newest keyframe does not see keep their linearisation (`held_landmarks`). `reversal` detects a window that has found the
reverse of the motion. `marginalisation` turns the oldest state into a prior (`window_prior`). `points` computes the
positions of the points that the newest state sees.

*The calibration.* `calibration` adds lenses, camera poses and the IMU's calibration errors to the window's unknowns.
"""
