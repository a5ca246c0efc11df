"""Errors as people see them: of images against their targets, and of recovered colours against the true ones."""

from __future__ import annotations

from reslrb_cli.report.seen.run import seen_errors

__all__ = ["seen_errors"]
