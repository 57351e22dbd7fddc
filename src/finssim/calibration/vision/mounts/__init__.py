"""Where tags, IMU and pressure port sit on the vehicle, from its motion."""
