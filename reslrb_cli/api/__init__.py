"""What a script or a notebook calls: the commands as functions, with arrays and records for files and lines.

`reslrb_cli.__all__` names what of it is public; docs/python.md is written of its docstrings.
"""
