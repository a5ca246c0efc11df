"""Guided emission: what light paths say by the cell that they start in, and tables that are learned of it."""
