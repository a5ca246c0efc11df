"""Reads records, draws plots, writes the HTML page of a run."""
