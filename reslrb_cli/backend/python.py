"""Processes of our own that run Python."""

from __future__ import annotations

import os
import sys


def python_command(code: str) -> list[str]:
    """The command line of a Python that runs `code` and imports modules from where this process does.

    Left to itself Python looks in the working folder first, where a scene may bring a `numpy.py` along.
    """
    path = [entry or os.getcwd() for entry in sys.path]
    return [sys.executable, "-c", f"import sys\nsys.path[:] = {path!r}\n{code}"]
