"""What is measured of a run before its first iteration: estimator, paths, guiding, sequence."""
