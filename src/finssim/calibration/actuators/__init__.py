"""Thrust curves, speed controllers, and motor responses, from benches and step logs."""
