"""How certain the values are that a run ends with: their spread about the optimum, and a verdict on each parameter."""

from __future__ import annotations

from reslrb_cli.optimization.certainty.measuring import Certainty
from reslrb_cli.optimization.certainty.records import CertaintyRecord

__all__ = ["Certainty", "CertaintyRecord"]
