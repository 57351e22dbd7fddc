"""Calibration by pictures: lens, camera pose and water plane, tags on the vehicle, its sensors' mounting."""
