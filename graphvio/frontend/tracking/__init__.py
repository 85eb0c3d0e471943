"""Tracking of corners from image to image, and from one single camera to another.

`tracker` follows the corners of one pair or single camera: `keyframe_patches` registers them on the keyframe's patches,
`lost_tracks` predicts where to search for those that were lost, `rolling_shutter` moves points to where a global
shutter would have seen them, by velocities that `measured_readouts` computes, and `steady_motion` predicts motion
without a back-end. `overlaps` finds the tracks of single cameras in other cameras with overlapping views, and
`handover` lets several of them follow the same point. `turn` measures the rotation of a single camera, and `standstill`
detects whether anything moves.
"""
