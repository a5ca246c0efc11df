"""Measurements: what a step costs. They yield records, and draw nothing."""
