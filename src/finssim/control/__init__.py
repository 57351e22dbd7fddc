"""Control: wrench allocation, action modes and the PID baseline, the same in simulation and on the robot."""
