"""Transfer to the virtual pool: jobs that are one trial each, campaigns of them, and what their intervals support."""
