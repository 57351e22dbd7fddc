"""Experiments: the paper's definitions of its measures, its setpoints, and the figures drawn from them."""
