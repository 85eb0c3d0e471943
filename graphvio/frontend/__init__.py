"""The visual front-end: images of stereo pairs and single cameras in, relative poses of the rig with covariance out.

It follows sections 2 and 3 of the paper. In the front-end, `pair`, `pairs` and the index `j` stand for any group,
single cameras included.

*One pair.* `images` checks images and their masks, and `image_noise` measures their noise. `corners` finds corners
above it. `prediction` predicts where a motion puts points and how it deforms their patches, and `steady_motion` the
motion where there is no back-end; `keyframe_patches` finds a keyframe's patches in later images, and `lost_tracks`
those that the prediction has lost. `lucas_kanade` registers or follows, by the alignment of `patches`.
`matching` finds corners in the right image: `stereo` searches and triangulates, `slanted` aligns. `rolling_shutter`
moves points to where a global shutter would have seen them. `tracker` joins these, and `tracks` is what it returns.

*Single cameras.* `motion_stereo` finds the depth of their points from motion, and `depth_scale` corrects a motion for
the common scale of these depths. `overlaps` finds their tracks in other cameras whose views overlap, by the warped
patches of `warped_matching`; `handover` keeps the same point in several cameras. `turn` measures how a camera turns by
its tracks alone.

*All pairs.* `observations` puts the tracks of a reference and the present side by side. 3-point hypotheses
(`resection`) of every pair are scored on every pair (`cost`, `ransac`); the winner is refined and given its covariance
(`refinement`, with the normal equations of `linearisation`, of points in `blocks` whose errors `point_errors` whitens,
and the noise that `noise` estimates from the residuals). `selection` joins the pairs or decides between them;
`few_points` corrects a predicted motion by points that are too few for that. `depth_errors` has a motion's derivatives
with respect to errors of the depths; `paper_method` has eq. (1) to (4) as the paper writes them.

*Decisions.* `agreement` finds consensus sets of pairs, `quality` grades a motion, `references` says when a keyframe
ends. `extrinsics` has the poses of the cameras in body that are in force, and `extrinsic_monitor` tests the transfer
between pairs. `standstill` and `frozen` look for images that do not change. `thresholds` has all numbers that these
decisions depend on, and `pair_reports` reports what each pair contributed.

`visual` is the front-end of a rig with stereo pairs as the odometry uses it, `singles` that of a rig without; what both
do is in `tracking_frontend`.
"""
