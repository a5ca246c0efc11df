"""Whole optimisations by several methods, some seeds each, at equal wall time: loss and error against run time."""
