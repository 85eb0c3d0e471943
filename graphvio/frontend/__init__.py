"""The visual front-end: images of the stereo pairs in, relative poses of the rig with covariance out.

It follows sections 2 and 3 of the paper. Each pair finds corners (`corners`), tracks them (`flow`), matches and
triangulates them (`stereo`); `tracker` joins these for one pair. 3-point hypotheses (`resection`) of every pair are
scored on every pair (`cost`, `ransac`), the winner is refined and given its covariance (`refinement`), and `selection`
decides between pairs or joins them. `visual` is the front-end as the odometry uses it.
"""
