"""Bench measurements: thrust curves, speed controllers and the response of motors."""
