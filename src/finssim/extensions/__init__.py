"""Extensions: ROS 2, perception, teams and the viewer. Nothing in the core imports them."""
