"""ROS 2 for FinsSim: the real wire without a ROS installation, one source for messages, names and frames."""
