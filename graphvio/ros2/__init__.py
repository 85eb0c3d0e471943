"""ROS 2 topics and services over DDS, without a ROS installation."""
