"""Estimation of the rig's calibration while it moves, from the tracks of its cameras and the IMU."""
