"""The back-end: relative poses and IMU samples in, the rig's state with covariance out (section 5 of the paper).

`estimator` is the interface of a state estimator. `smoother_estimator` and `ekf.estimator` implement it, and
`graphvio.monocular.estimator` for rigs without stereo pairs. `gating` tests innovations. `smoother` is the fixed-lag
smoother over the factor graph of `window`, with the factors of `factors`, `preintegration` and `reference_views`;
`initial_state` makes the initial states of both estimators, and `initialisation` finds the first attitude. `inertial`
buffers the IMU, `propagation` predicts at its rate, and `time_offset` estimates its time offset.
"""
