"""The motion of the rig between two framesets, with covariance, by the points of all pairs (sections 3 and 3.1).

`observations` puts the tracks of a reference and the present side by side. 3-point hypotheses (`resection`) of every
pair are scored on every pair (`cost`, `ransac`); the winner is refined and given its covariance (`refinement`, with the
normal equations of `linearisation`, of points in `blocks` whose errors `point_errors` whitens, and the noise that
`noise` estimates from the residuals). `selection` joins the pairs or decides between them, and `quality` grades the
result. `few_points` corrects a predicted motion by points that are too few for that. `depth_errors` has a motion's
derivatives with respect to errors of the depths, and `depth_scale` corrects it for the common scale of a single
camera's depths. `paper_method` has eq. (1) to (4) as the paper writes them.
"""
