"""FinsSim's nodes as a ROS 2 package; their code is in `nodes` and `worlds` of `finssim.extensions.ros2`."""
