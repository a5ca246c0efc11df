"""Reads records, draws plots, writes the HTML page of a run."""

from __future__ import annotations

from reslrb_cli.report.page import write_report

__all__ = ["write_report"]
