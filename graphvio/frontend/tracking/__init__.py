"""Tracks from image to image: followed, lost, replenished, and kept where another camera goes on with them.

`tracker` follows the corners of one pair or single camera: `keyframe_patches` registers them on the keyframe's patches,
`lost_tracks` looks for those that a prediction has lost, `rolling_shutter` moves points to where a global shutter would
have seen them, and `steady_motion` predicts without a back-end. `overlaps` finds the tracks of single cameras in others
that see the same, and `handover` keeps the same point in several of them. `turn` measures how a camera turns, and
`standstill` whether anything moves.
"""
