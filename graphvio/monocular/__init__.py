"""Odometry of single cameras with an IMU: scale from the accelerometer, a window of keyframes with landmarks."""
