"""Tracks of a pair or single camera at one instant, and where their points are: by stereo, or by motion.

`tracks` is what is known of them. `prediction` puts them where a motion takes them, and deforms their patches.
`matching` finds corners in the right image: `stereo` searches along the epipolar curve and triangulates, `slanted`
aligns patches; `warped_matching` does so between cameras that look different ways. A single camera's points have their
depth from its motion (`motion_stereo`), and so has the slant of the surfaces that it sees (`motion_slants`).
"""
