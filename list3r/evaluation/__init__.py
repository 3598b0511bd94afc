"""Measures against known truth: trajectories, clouds, instances, relations, revisits. Nothing here knows the store."""
