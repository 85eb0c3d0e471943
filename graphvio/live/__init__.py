"""The odometry on live sensors, in real time."""
