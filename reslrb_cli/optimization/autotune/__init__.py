"""Measurements before the first iteration of a run: estimator, paths, guiding, sequence."""
