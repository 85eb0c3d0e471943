"""Sessions on disk: MCAP files with ROS 2 messages; and bags."""
