"""Estimation of the rig's motion between two framesets, with covariance, from all pairs' points (sections 3 and 3.1).

`observations` joins the tracks of a reference and of the current frameset. 3-point hypotheses (`resection`) of every
pair are scored on every pair (`cost`, `ransac`). The best one is refined and gets its covariance (`refinement`):
`linearisation` computes the normal equations of points stored in `blocks`, whose errors `point_errors` whitens, and
`noise` estimates the noise from the residuals. `selection` estimates one motion jointly from all pairs or chooses
between the pairs, and `quality` grades the result. `few_points` corrects a predicted motion by points that are too few
to measure one. `depth_errors` and `readout_errors` compute a motion's derivatives with respect to errors of the depths
and of the velocities that compensate rolling shutters; `depth_scale` corrects a motion for the common scale of a single
camera's depths. `paper_method` has eq. (1) to (4) as the paper writes them.
"""
