"""Losses, optimisers, constraints, schedules, and the loop that joins them; nothing here opens a file to write."""

from __future__ import annotations

from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.problem import Problem, assemble, assemble_scene
from reslrb_cli.optimization.reach import find_reached

__all__ = ["Problem", "assemble", "assemble_scene", "find_reached", "optimize"]
