"""Self-contained HTML pages about runs and measurements, which load no other files."""

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
from reslrb_cli.report.sources import ShownRun, Source, read_run

Array = np.ndarray[Any, Any]

#: Seconds after which the page of a run in progress reloads itself.
REFRESH_SECONDS = 5


def write_report(
    folder: Path, manifest: Mapping[str, Any] | None = None, current: Mapping[str, Array] | None = None
) -> Path:
    """Write `report.html` into a run folder from the content of the folder. Return the path of the report.

    Images are embedded, so the page can be moved. Files that the folder lacks, such as those of a failed run, are left
    out. For a run in progress, pass its current manifest and parameter values. The page then reloads itself until its
    last version.
    """
    run = read_run(folder)
    if manifest is not None:
        run = replace(run, manifest=manifest, current=current or {})
    path = folder / "report.html"
    write_page([run], path, live=manifest is not None)
    return path


def write_page(sources: Sequence[Source], path: Path, live: bool = False) -> None:
    """Write one page about all `sources` to `path`, atomically. With `live`, the page reloads itself."""
    page = render(sources, live)
    write_atomically(path, lambda file: file.write(page.encode("utf-8", "replace")))


def render(sources: Sequence[Source], live: bool = False) -> str:
    """Return the page about one run, or about several sources side by side, as HTML."""
    if len(sources) == 1 and isinstance(sources[0], ShownRun):
        run = sources[0]
        title, head, parts = run.name, guarded(partial(header, run)), list(run_parts(run).items())
    else:
        title, head, parts = several_parts(sources)
    return document(title, head, parts, REFRESH_SECONDS if live else None)
