"""Models driven with recorded inputs, scored against what was recorded."""
