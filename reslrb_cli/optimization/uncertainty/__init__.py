"""Certainty of the final values of a run: their spread around the optimum, and a verdict on each parameter."""
