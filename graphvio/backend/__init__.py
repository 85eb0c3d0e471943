"""The back-end: relative poses and IMU samples in, the rig's state with covariance out (section 5 of the paper).

`inertial` buffers the IMU and `preintegration` sums it up, `propagation` predicts at its rate, `initialisation` finds
the first attitude, `starts` says what the smoother starts from, at first and after breaks, `gating` tests vision
against the prediction, `window` is the fixed-lag factor graph, and `smoother` joins them to the estimator that the
odometry uses.
"""
