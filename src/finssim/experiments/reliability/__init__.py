"""What a robot does when things break: faults on its wires, long runs, and its timing."""
