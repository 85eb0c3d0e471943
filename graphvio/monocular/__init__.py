"""Odometry of single cameras with an IMU: scale from the accelerometer, a window of keyframes with landmarks.

Without a stereo pair there is no motion in metres to hand over: landmarks, states, IMU and calibration are solved for
in one window, at each frameset. Begin to read at `estimator`.

*The first window.* `initialiser` collects keyframes until the scale is known: `closed_form` guesses velocity, gravity
and depths, `adjustment` solves, and `overlap_trust` asks whether overlapping views agree with the accelerometer.

*The window.* `window` holds the states (`states`), what was seen from them (`sightings`) and the IMU in between
(`sample_buffer`). `window_solver` solves it at a frameset: `equations` are its normal equations, with the landmarks
eliminated (`structure`, with the errors of `reprojection`); between keyframes, landmarks are held as they were
linearised (`held_landmarks`). `reversal` recognises the reverse of the motion. `marginalisation` turns the oldest state
into a prior (`window_prior`). `points` locates what the newest state sees.

*The calibration.* `calibration` has lenses, places and the IMU's errors as unknowns of the window.
"""
