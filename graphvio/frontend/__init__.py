"""The visual front-end: images of the stereo pairs in, relative poses of the rig with covariance out.

It follows sections 2 and 3 of the paper.

*One pair.* `corners` finds corners above the image's noise. `prediction` predicts where a motion puts them and how it
deforms their patches; `keyframe_patches` finds a keyframe's patches in later images. `lucas_kanade` registers or
follows, by the alignment of `patches`. `matching` finds corners in the right image: `stereo` searches and triangulates,
`slanted` aligns. `tracker` joins these, and `tracks` is what it returns.

*All pairs.* `observations` puts the tracks of a reference and the present side by side. 3-point hypotheses
(`resection`) of every pair are scored on every pair (`cost`, `ransac`); the winner is refined and given its covariance
(`refinement`, with the normal equations of `linearisation` and the noise that `noise` estimates from the residuals).
`selection` joins the pairs or decides between them; `paper_method` has eq. (1) to (4) as the paper writes them.

*Decisions.* `agreement` finds consensus sets of pairs, `quality` grades a motion, `references` says when a keyframe
ends, `alignment` monitors the transfer between pairs, `standstill`, `frozen` and `images` check the images;
`thresholds` has all numbers that these decisions depend on.

`visual` is the front-end as the odometry uses it.
"""
