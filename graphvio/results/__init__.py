"""The result folder of a run.

| file | contents |
|---|---|
| ``trajectory.txt`` | TUM: pose of body in nav as emitted, one line per frameset that has one |
| ``trajectory_smoothed.txt`` | the same poses as they left the smoother's window |
| ``covariance.csv`` | upper triangle (21) of the pose's covariance, tangent ``[rotation, translation]`` in body |
| ``imu_bias.csv`` | biases of gyro (rad/s) and accelerometer (m/s^2) |
| ``gravity.csv`` | gravity in nav (m/s^2), by which nav is off the level, and the sigma of roll and pitch (rad) |
| ``pairs.csv`` | points, inliers and residuals (px), one line per estimate and pair |
| ``events.jsonl`` | gates, resets, losses and faults of the input, one JSON object per line |
| ``config.yaml``, ``rig.yaml`` | as used |
| ``summary.json`` | see `Summary` |
| ``trajectory.png`` | plan and side view |
| ``calibration.csv``, ``calibration.png`` | the calibration over time, as differences from the rig file |
| ``rig-refined.yaml`` | the rig with the calibration as it was known at the end |
"""

from graphvio.results.summary import FinishedRun, PairMedians, Percentiles, Summary
from graphvio.results.writer import ResultWriter

__all__ = ["FinishedRun", "PairMedians", "Percentiles", "ResultWriter", "Summary"]
