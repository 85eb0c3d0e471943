"""The odometry as the front-end of a SLAM system: keyframes out, global corrections in."""
