"""The folder that a run leaves behind.

| file | holds |
|---|---|
| ``trajectory.txt`` | TUM: pose of body in nav as emitted, one line per frameset that has one |
| ``trajectory_smoothed.txt`` | the same with all later measurements taken into account |
| ``covariance.csv`` | upper triangle (21) of the pose's covariance: ``[rotation, translation]``, frame body |
| ``imu_bias.csv`` | biases of gyro (rad/s) and accelerometer (m/s^2) |
| ``pairs.csv`` | points, inliers and residuals (px) of each pair, one line per estimate and pair |
| ``events.jsonl`` | gates, resets, losses and faults of the input, one JSON object a line |
| ``config.yaml``, ``rig.yaml`` | as used |
| ``summary.json`` | see `Summary` |
| ``trajectory.png`` | plan and side view |
"""

from graphvio.results.summary import PairMedians, Percentiles, Summary
from graphvio.results.writer import ResultWriter

__all__ = ["PairMedians", "Percentiles", "ResultWriter", "Summary"]
