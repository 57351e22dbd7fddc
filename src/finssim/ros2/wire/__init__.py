"""The wire of ROS 2 from Python alone: discovery, topics and services of a participant, over Cyclone DDS."""
