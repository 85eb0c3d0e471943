"""Tracks of a pair or single camera at one instant, and the depth of their points: by stereo, or by motion.

`tracks` stores all that is measured of them. `prediction` predicts their pixels after a motion, and the deformation of
their patches. `matching` finds corners in the right image: `stereo` searches along the epipolar curve and triangulates,
`slanted` aligns patches. `warped_matching` does so between cameras that point in different directions. For a single
camera, `motion_stereo` computes the depth of points from its motion, and `motion_slants` the slant of surfaces.
"""
