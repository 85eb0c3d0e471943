"""Sessions on disk: MCAP files with ROS 2 messages, bags of ROS 1 and ROS 2, and the EuRoC/ASL layout."""
