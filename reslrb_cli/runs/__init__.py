"""A run and its record: what a run folder is told while an optimisation works, how it ends, and how it goes on.

Knows no command line: who calls says what is shown, and when to stop.
"""
