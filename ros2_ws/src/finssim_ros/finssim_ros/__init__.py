"""FinsSim's nodes as a ROS 2 package; their code is in `finssim.ros2.nodes` and `finssim.ros2_worlds`."""
