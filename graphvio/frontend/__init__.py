"""The visual front-end: images of stereo pairs and single cameras in, relative poses of the rig with covariance out.

It follows sections 2 and 3 of the paper. In the front-end, `pair`, `pairs` and the index `j` stand for any group,
single cameras included. Its packages, from the bottom up:

- `imaging`: corners and patches of images.
- `depth`: the tracks at one instant, and their depth by stereo or motion.
- `tracking`: the tracks from image to image.
- `motion`: the motion of the rig between two framesets, eq. (1) to (4).
- `pairs`: whether the pairs agree, and where they are in body.

`visual` is the front-end of a rig with stereo pairs as the odometry uses it, `singles` that of a rig without; what both
do is in `tracking_frontend`. `references` says when a keyframe ends. `thresholds` has all numbers that decisions depend
on.
"""
