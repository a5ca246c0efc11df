"""Files that the measuring commands write with `--json`, on the disk while they go on.

A file says what measured, then has one object a line: what has been measured so far.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.cli.terminal import echo
from reslrb_cli.records.atomic import remove_parts_of
from reslrb_cli.records.measurement_files import (
    Kept,
    Line,
    LineFile,
    Origin,
    are_kept,
    read_samples,
    samples_file,
    write_samples,
)
from reslrb_cli.runs.recorder import LivePage


def origin_of(variant: str) -> Origin:
    """What this process measures on, under `variant`."""
    return Origin(device_name(variant), variant)


class Keeper:
    """Keeps a JSON file, and beside it what can be gone on from, so that a process that is killed loses seconds.

    `origin` is the first line, `final` has the other ones that no later one changes, `provisional` the rest, as of now;
    `kept` what a later session needs, None where there is nothing yet. Where no file is asked for nothing is done.
    """

    def __init__(
        self,
        json_file: Path | None,
        origin: Line,
        final: Callable[[], Sequence[Line]],
        provisional: Callable[[], Sequence[Line]],
        kept: Callable[[], Kept | None],
    ) -> None:
        self._file = None if json_file is None else LineFile(json_file)
        self._samples = None
        if json_file is not None and self._file is not None and not self._file.is_stream:
            self._samples = samples_file(json_file)
            remove_parts_of(self._samples)
        self._origin, self._final, self._provisional, self._kept = origin, final, provisional, kept
        self._live = LivePage(self._save, "the file of --json")

    def refresh(self) -> None:
        """Write, if it is time to: every few seconds, and no more than a small share of the time. Between steps."""
        if self._file is None:
            return
        if self._file.is_stream:  # which has lines as they come
            self._file.write([self._origin, *self._final()])
        else:
            self._live.refresh()

    def finish(self, lines: Sequence[Line]) -> None:
        """Write all `lines`, none of which changes any more. Raises OSError."""
        if self._file is not None:
            if not self._write(self._file, lines):
                echo("what was sampled is too large to be kept: --resume cannot go on from it")
            self._file.close()

    def _save(self) -> None:
        assert self._file is not None
        self._write(self._file, self._final(), self._provisional())

    def _write(self, file: LineFile, final: Sequence[Line], provisional: Sequence[Line] = ()) -> bool:
        """Write both files; whether what there is to be kept is."""
        kept = None if self._samples is None else self._kept()
        fits = kept is None or are_kept(kept[1])
        if self._samples is not None:
            if kept is not None and fits:
                write_samples(self._samples, *kept)
            else:  # what may lie there is not of these lines
                self._samples.unlink(missing_ok=True)
        file.write([self._origin, *final], provisional)
        return fits


def read_earlier(json_file: Path) -> Kept:
    """What lies beside a JSON file that another call has written. Raises ConfigError."""
    return read_samples(samples_file(json_file))
