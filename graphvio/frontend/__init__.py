"""The visual front-end: images of stereo pairs and single cameras in, relative poses of the rig with covariance out.

It follows sections 2 and 3 of the paper. In the code of the front-end, `pair`, `pairs` and the index `j` stand for any
group of cameras: a stereo pair or a single camera. Its packages, from the bottom up:

- `imaging`: corners and patches of images.
- `depth`: the tracks at one instant, and their depth by stereo or motion.
- `tracking`: the tracks from image to image.
- `motion`: the motion of the rig between two framesets, eq. (1) to (4).
- `pairs`: consensus of the pairs' motions, and the extrinsics between pairs.

`visual` is the front-end of a rig with stereo pairs, `singles` that of a rig of single cameras only; their common base
class is in `tracking_frontend`. `references` decides when a keyframe ends, `lookalikes` removes false second motions
that repetitive texture causes, and `readouts` compensates rolling shutters by velocities that vision measures.
`thresholds` has all numbers that decisions depend on.
"""
