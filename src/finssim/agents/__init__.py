"""Agents: what acts in a task, from classical controllers and scripted baselines to policies."""
