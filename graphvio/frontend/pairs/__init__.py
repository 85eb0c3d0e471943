"""Comparison of the pairs' motions with each other, and the extrinsics between pairs.

`agreement` finds consensus sets of pairs. `extrinsics` has the poses of the cameras in body that are in force, and
`extrinsic_monitor` tests and corrects the transfer between pairs. `pair_reports` reports what each pair contributed.
"""
