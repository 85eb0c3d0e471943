"""The odometry: measurements of the sensors in, estimates out.

`odometry` is the recipe, a frameset at a time; `step` is what its listeners get, and `assembly` puts estimates
together.

*The IMU.* `synchroniser` holds framesets until the IMU covers them (`spike_filter`, `stamp_jitter`). `frameset_imu` is
the IMU around a frameset, and watches it: `imu_watch` leaves it out while it contradicts vision (pairs), `clock_watch`
and `imu_clock` find its clock off (single cameras). `group_clocks` and `time_offset_correction` correct the stamps.

*The calibration.* `online_calibration` is what it does for the odometry: nothing (`fixed_calibration`), or it is
estimated for pairs (`pairs_calibration`) or single cameras (`singles_calibration`); the innovation test allows for its
errors (`calibration_innovation_covariance`). `recorded_calibration` calibrates from a whole recording.

*Reports.* `vision_events` and `rig_mistakes` say what is wrong, `angular_rates` and `nav_frame` serve the estimates.
"""

from graphvio.odometry.odometry import Odometry

__all__ = ["Odometry"]
