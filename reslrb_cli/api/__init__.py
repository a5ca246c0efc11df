"""Python interface for scripts and notebooks: the commands as functions that return arrays and records.

`reslrb_cli.__all__` lists the public names. The reference in docs/python.md is generated from the docstrings of the
public names.
"""
