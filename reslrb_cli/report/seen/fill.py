"""Runs of which errors as people see them were never recorded: they are found in what the folder holds."""

from __future__ import annotations

from dataclasses import replace

from reslrb_cli.report.seen.run import seen_errors
from reslrb_cli.report.sources import Run, Source


def with_seen_errors(source: Source) -> Source:
    """The same, with those errors among its results where it is a run that can have them and does not."""
    if not isinstance(source, Run) or "seen" in source.results:
        return source
    try:
        found = seen_errors(source.path, source.results, source.manifest.get("views"))
    except Exception:  # what lies in the folder is damaged, in a way that nobody thought of; the page goes on without
        return source
    results = {**source.results, "seen": found}
    return replace(source, manifest={**source.manifest, "results": results}) if found else source
