"""A small SLAM system on top of the odometry: place recognition, a pose graph and maps on disk."""
