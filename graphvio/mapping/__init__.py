"""A small SLAM system beside the odometry: places recognised, a pose graph, a map that is kept."""
