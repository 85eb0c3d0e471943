"""Calibration of P_12, the relative pose of stereo pairs that share no view, from their motions (section 4)."""
