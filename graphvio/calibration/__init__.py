"""P_12, the transfer between stereo pairs that share no view, from their motions (section 4)."""
