"""Sessions on disk: MCAP files with ROS 2 messages, which Foxglove, ``ros2 bag`` and PlotJuggler open as they are."""
