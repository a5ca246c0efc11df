"""Measurements, which yield records and draw nothing."""
