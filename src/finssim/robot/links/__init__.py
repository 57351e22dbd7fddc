"""Links to the motor controller: encoding of frames, transports, and the comparison of its clock with the robot's."""
