"""Runs and sweeps: preparing, recording, resuming and exporting them.

This package is independent of the command line: the caller decides what to show and when to stop.
"""
