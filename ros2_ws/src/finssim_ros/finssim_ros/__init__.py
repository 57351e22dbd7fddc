"""FinsSim's nodes as a ROS 2 package; their code is `finssim.ros2.nodes`."""
