"""Software of the robot: the wire, the bridge, the control loop, the record. No simulator, no torch, no ROS."""
