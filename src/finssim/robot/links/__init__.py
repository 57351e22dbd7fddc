"""The wire to the motor controller: its frames as bytes, how they travel, and its clock against the robot's."""
