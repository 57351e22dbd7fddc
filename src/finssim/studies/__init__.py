"""Studies: the paper's tables, the demo and the sweep, one command each."""
