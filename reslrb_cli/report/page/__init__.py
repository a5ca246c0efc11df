"""Pages about runs and measurements, each complete in itself: no script, no network, no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.report.page.layout import document
from reslrb_cli.report.page.measured import several_parts
from reslrb_cli.report.page.run import guarded, header, run_parts
from reslrb_cli.report.sources import Run, Source, read_run

Array = np.ndarray[Any, Any]

#: Seconds after which the page of a run that is still at work loads itself again.
REFRESH_SECONDS = 5


def write_report(
    folder: Path, manifest: Mapping[str, Any] | None = None, current: Mapping[str, Array] | None = None
) -> Path:
    """Write `report.html` into a run folder from what the folder holds; return its path.

    Images are embedded, so the page can be moved away from the run. What the folder lacks, as that of a run that failed
    does, is left out. Of a run that is still at work `manifest` is what that would say now, and `current` its
    parameters' values: its page loads itself again, until it is written for the last time.
    """
    run = read_run(folder)
    if manifest is not None:
        run = replace(run, manifest=manifest, current=current or {})
    path = folder / "report.html"
    write_page([run], path, live=manifest is not None)
    return path


def write_page(sources: Sequence[Source], path: Path, live: bool = False) -> None:
    """Write one page about all of `sources` to `path`, atomically; `live`: it is about to be written again."""
    page = render(sources, live)
    write_atomically(path, lambda file: file.write(page.encode("utf-8", "replace")))


def render(sources: Sequence[Source], live: bool = False) -> str:
    """The page about these as HTML: of one run its own, of several with beside each other what can be compared."""
    if len(sources) == 1 and isinstance(sources[0], Run):
        run = sources[0]
        title, head, parts = run.name, guarded(partial(header, run)), list(run_parts(run).items())
    else:
        title, head, parts = several_parts(sources)
    return document(title, head, parts, REFRESH_SECONDS if live else None)
