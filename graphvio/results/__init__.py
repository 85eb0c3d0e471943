"""The result folder of a run.

| file | contents |
|---|---|
| ``trajectory.txt`` | TUM format: pose of body in nav as emitted, one line per frameset with a pose |
| ``trajectory_smoothed.txt`` | the same poses, with their values when they left the smoother's window |
| ``covariance.csv`` | upper triangle (21) of the pose's covariance, tangent ``[rotation, translation]`` in body |
| ``imu_bias.csv`` | biases of gyro (rad/s) and accelerometer (m/s^2) |
| ``gravity.csv`` | gravity in nav (m/s^2), which shows the tilt of nav, and the larger sigma of roll and pitch (rad) |
| ``pairs.csv`` | points, inliers and residuals (px), one line per estimate and pair |
| ``events.jsonl`` | rejections by gates, resets, losses and faults of the input, one JSON object per line |
| ``config.yaml``, ``rig.yaml`` | configuration and rig of the run |
| ``summary.json`` | see `Summary` |
| ``trajectory.png`` | plan and side view |
| ``calibration.csv``, ``calibration.png`` | the calibration over time, as differences from the rig file |
| ``rig-refined.yaml`` | the rig with the calibration that was estimated at the end |
"""

from graphvio.results.summary import FinishedRun, PairMedians, Percentiles, Summary
from graphvio.results.writer import ResultWriter

__all__ = ["FinishedRun", "PairMedians", "Percentiles", "ResultWriter", "Summary"]
