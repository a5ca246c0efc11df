"""Whole optimisations by several methods, some seeds each, at equal wall time: loss and error against run time.

`evaluate` is what the processes do, `session` has them take turns, `rank` says what the runs come to and who is the
best. What is measured is the `RunsPlan` of `measure/methods.py`.
"""
