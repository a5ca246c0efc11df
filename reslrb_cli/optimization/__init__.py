"""Losses, optimisers, constraints, schedules, and the loop that combines them. Nothing in this package writes files."""
