"""Learning: training on the batched environment, and trained networks as policy directories."""
