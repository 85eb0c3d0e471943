"""ROS 2 topics over DDS, without a ROS installation."""
