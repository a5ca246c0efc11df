"""Whole optimisations by several methods, some seeds each, at equal wall time: loss and error against run time.

`plan` says what is measured, `runner` and `judge` are what the processes do, `session` has them take turns, `verdict`
says who is the best.
"""
