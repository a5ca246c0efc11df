"""Losses, optimisers, constraints, schedules, and the loop that combines them; nothing here writes files."""
