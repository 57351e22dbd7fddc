"""Real to sim: from logs of trials to a calibrated vehicle, with uncertainty."""
