"""Pairs against each other: whether they agree, and where they are in body.

`agreement` finds consensus sets of pairs. `extrinsics` has the poses of the cameras in body that are in force, and
`extrinsic_monitor` tests the transfer between pairs. `pair_reports` reports what each pair contributed.
"""
