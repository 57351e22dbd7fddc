"""Demonstrations from records of runs: what a person or a controller did with a vehicle, as a data set."""
