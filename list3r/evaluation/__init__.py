"""Measures against known truth: trajectories, clouds, instances, relations. Nothing here knows the store."""
