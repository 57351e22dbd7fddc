"""Thrust curves, speed controllers, motor responses and speed loops, from benches and step logs."""
