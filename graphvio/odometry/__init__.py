"""The odometry, which turns measurements of the sensors into estimates.

`odometry` has the main loop, which processes one frameset at a time; `step` has the data that its subscribers receive,
and `assembly` puts estimates together.

*The IMU.* `synchroniser` holds framesets until the IMU covers them (`spike_filter`, `stamp_jitter`). `frameset_imu`
provides the IMU readings around a frameset, and monitors the IMU: `imu_watch` leaves it out while it contradicts vision
(pairs), and `clock_watch` finds an error of its clock (single cameras), which `imu_clock` corrects. `group_clocks` and
`time_offset_correction` correct the stamps.

*The calibration.* `online_calibration` is the interface of a calibration during the run: it is fixed
(`fixed_calibration`), or estimated for pairs (`pairs_calibration`) or single cameras (`singles_calibration`); the
innovation test allows for its errors (`calibration_innovation_covariance`). `recorded_calibration` calibrates from a
whole recording.

*Reports.* `vision_events` and `rig_mistakes` report what is wrong with images and rig; `angular_rates` and `nav_frame`
convert values for the estimates.
"""

from graphvio.odometry.odometry import Odometry

__all__ = ["Odometry"]
