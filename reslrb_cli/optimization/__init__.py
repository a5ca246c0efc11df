"""Losses, optimisers, constraints, schedules, and the loop that joins them; nothing here opens a file to write."""
