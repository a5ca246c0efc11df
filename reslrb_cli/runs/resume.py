"""Resuming a run exactly where it stopped: open its folder, read its state, assemble its problem."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reslrb_cli.config.loader import OVERRIDDEN, Override, dump, loads
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, MachineError, is_machine_fault
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.state import Settled, State
from reslrb_cli.records.checkpoint import PREVIOUS_FILE_NAME, STATE_FILE
from reslrb_cli.records.manifest import Manifest, Status, now, versions
from reslrb_cli.records.metrics import METRICS_FILE, cut_back
from reslrb_cli.records.run_folder import RunFolder, check_writable, opened, read_config, write_beginning
from reslrb_cli.records.tree import Stored
from reslrb_cli.runs.log import collected
from reslrb_cli.runs.prepare import (
    PLACE,
    Change,
    PreparedRun,
    RunProgress,
    changes,
    check_changes,
    check_files,
    manifest_of,
)

Say = Callable[[str], None]

logger = logging.getLogger(__name__)


@dataclass
class OpenedRun:
    """Run to be resumed: its locked folder, its manifest, its stored state and the new configuration.

    `changed` holds the settings that differ from those at the start of the run. `iteration` is the number of completed
    iterations. `said` collects warnings.
    """

    folder: RunFolder
    manifest: dict[str, Any]
    stored: Stored
    settled: Settled
    config: Config
    changed: dict[str, Change]
    iteration: int
    said: list[str] = field(default_factory=list)

    @property
    def is_done(self) -> bool:
        """True if the run is complete under the new configuration."""
        is_finished = self.manifest.get("status") == Status.FINISHED
        return is_finished and (self.config.run.iterations == self.iteration or self.has_stopped)

    @property
    def has_stopped(self) -> bool:
        """True if the run ended before its last iteration, and `run.max_seconds` is unchanged."""
        return bool(self.stored.read(State).stopped) and "run.max_seconds" not in self.changed

    def done_line(self, option: str, equals: str) -> str:
        """Return a line that the run is complete. The line names the setting that would continue the run.

        `option` and `equals` are parts of the syntax for changing a setting.
        """
        iterations = self.config.run.iterations
        stopped = iterations > self.iteration and self.stored.read(State).stopped
        more = f"run.{'max_seconds' if stopped else 'iterations'}{equals}NUMBER"
        done = f"{self.iteration} of {iterations} iterations"
        if stopped and self.config.run.max_seconds is None:
            return f"{self.config.source.parent}: is finished, after {done}: {stopped}"
        return f"{self.config.source.parent}: is finished, after {done}; {option} {more} continues it"

    def begin(self, variant: str, say: Say, warn: Say) -> PreparedRun:
        """Assemble the problem of the run and restore its state. A variant must be set.

        Raises ConfigError and UnsupportedScene.
        """
        with collected() as said:
            problem = assemble(self.config, say, to_run=True, settled=self.stored)
        manifest = self._manifest(manifest_of(problem, variant, self.config.source))
        course = RunProgress(problem, variant)
        course.restore(self.stored)
        if not self.has_stopped:
            course.go_on()
        measured = course.state.scaling
        manifest.scaling = None if measured is None else [row.to_json() for row in measured]
        for line in self.said:
            warn(line)
        return PreparedRun(course, manifest, lambda: self._take_over(manifest), said)

    def _manifest(self, manifest: Manifest) -> Manifest:
        before, here = self.manifest, versions()
        manifest.started = before.get("started", manifest.started)
        manifest.commit = before.get("commit")  # the configuration is now that of the run folder
        manifest.resumed = list(before.get("resumed", []))
        manifest.incomplete = list(before.get("incomplete", []))
        earlier = before.get("versions", {})
        others = {name: [version, here.get(name)] for name, version in earlier.items() if version != here.get(name)}
        if others:
            names = ", ".join(f"{name} {was} then, {is_} now" for name, (was, is_) in others.items())
            self.said.append(f"versions have changed since the run began: {names}; results may differ")
        manifest.resumed.append(
            {
                "iteration": self.iteration,
                "at": now(),
                "command_line": manifest.command_line,
                "from": str(self.stored.path.absolute()),
                "changed": {key: list(change) for key, change in self.changed.items()},
                "versions": others,
            }
        )
        return manifest

    @contextlib.contextmanager
    def _take_over(self, manifest: Manifest) -> Iterator[RunFolder]:
        """Yield the locked folder in which the run continues. The folder has `manifest` and the metrics up to the run's
        state.

        Raises ConfigError and MachineError if the folder cannot be written to.
        """
        folder = self.folder
        try:
            write_beginning(folder, dump(self.config), manifest)
            if missing := cut_back(folder.path, self.iteration):
                lacks = f"lacks {missing} of the {self.iteration} iterations of the checkpoint, and so does the page"
                logger.warning(f"{folder.path / METRICS_FILE}: {lacks}")
            if self.stored.path.name == PREVIOUS_FILE_NAME:  # the newest state is damaged
                (folder.checkpoint / PREVIOUS_FILE_NAME).replace(folder.checkpoint / STATE_FILE)
        except OSError as error:
            if is_machine_fault(error):
                raise MachineError(f"{folder.path}: {error.strerror}; the run was not continued") from None
            raise
        yield folder


@contextlib.contextmanager
def open_earlier(run: Path, overrides: Sequence[str | Override]) -> Iterator[OpenedRun]:
    """Open the run in the folder `run` to resume it, and lock it while the block runs.

    The configuration is `config.yaml` in the run's folder, with `overrides`. Raises ConfigError if the folder holds no
    run, the run is in use, or the last two states are both damaged. Raises ConfigError also if a setting that must not
    change differs, or if `run.iterations` is below the number of finished iterations. Raises ConfigError also if an
    input file has changed, or if the folder cannot be written to.
    """
    with opened(run) as (folder, manifest):
        said: list[str] = []
        stored = _read_state(folder, said)
        settled, iteration = stored.read(Settled), stored.read(State).iteration
        began = loads(settled.config, stored.path)
        config, source = read_config(run, overrides), read_config(run)
        found = changes(began, config)
        asked = changes(source, config)
        blamed = "--set" if all(isinstance(each, str) for each in overrides) else OVERRIDDEN
        for key in PLACE:
            if key in asked:
                reason = f"cannot change now; to leave {run} as it is, copy it and resume the copy"
                raise ConfigError(blamed, key, reason)
        differing = check_changes(found, lambda key: blamed if key in asked else config.source, run, config)
        if config.run.iterations < iteration:
            reason = f"is {config.run.iterations}; the run has done {iteration} already"
            raise ConfigError(config.source, "run.iterations", reason)
        check_files(settled.files, config, str(run))
        earlier = OpenedRun(folder, manifest, stored, settled, config, differing, iteration, said)
        if not earlier.is_done:
            check_writable(folder)
        yield earlier


def _read_state(folder: RunFolder, said: list[str]) -> Stored:
    """Return the newest undamaged state in the folder."""
    failures: list[ConfigError] = []
    for name in (STATE_FILE, PREVIOUS_FILE_NAME):
        path = folder.checkpoint / name
        if not path.exists():
            continue
        try:
            stored = Stored(path)
        except ConfigError as error:
            failures.append(error)
            continue
        if failures or name == PREVIOUS_FILE_NAME:
            why = str(failures[0]) if failures else f"{folder.checkpoint / STATE_FILE}: is missing"
            said.append(f"{why}; continuing from the previous state, after {stored.read(State).iteration} iterations")
        return stored
    if failures:
        raise failures[0]
    raise ConfigError(folder.path, "", f"has no checkpoint/{STATE_FILE}: the run ended before it kept anything")
