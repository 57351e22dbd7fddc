"""Studies of this repository, run from a checkout: `python -m studies.faults --help`."""
