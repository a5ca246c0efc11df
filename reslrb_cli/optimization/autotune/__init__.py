"""Decisions before the first iteration of a run: paths, pixels, guiding, and sequence."""
