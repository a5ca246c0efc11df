"""The end of a run, part by part: each stands alone, the manifest comes first, and it says what is missing.

`tell` says what an error comes to: the one line that a user sees, and the exit code.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

from reslrb_cli.errors import MachineError, describe, is_machine_fault, tell
from reslrb_cli.records.atomic import remove_parts
from reslrb_cli.records.checkpoint import STATE_FILE, newest_checkpoint
from reslrb_cli.records.images import PARAMETERS_FILE as PARAMETERS_FILE_NAME
from reslrb_cli.records.manifest import Manifest, Status
from reslrb_cli.records.run_folder import RunFolder

logger = logging.getLogger(__name__)


#: Why a part is missing from a folder whose process ended before it came to that part.
NOT_YET = "not written yet"


class Ending:
    """How the run in `folder` ends: with `status`, and with `failure` where something failed before.

    A part that fails is noted in `manifest.missing`, and the others are still done. The first failure of all is that of
    the run, unless it is the page's: what the run is for is there without it. `kept` says what a reader will find.
    """

    def __init__(
        self,
        folder: Path,
        manifest: Manifest,
        status: Status,
        failure: BaseException | None,
        kept: Callable[[], str],
    ) -> None:
        self._folder, self._manifest, self._kept = folder, manifest, kept
        self._status, self._failure = status, failure

    def begin(self, parts: Sequence[str]) -> None:
        """Write the manifest, from here on the truth: these parts are still missing."""
        self._manifest.missing = dict.fromkeys(parts, NOT_YET)
        self._write_manifest()

    def part(self, name: str, work: Callable[[], object]) -> None:
        """Do a part. Only what was begun with is ever missing from the manifest of a run that ended well."""
        try:
            work()
        except Exception as error:
            self._manifest.missing[name] = describe(error)
            if self._failure is None:
                self._status, self._failure = Status.FAILED, error
            elif not self._is_like_failure(error):  # else one line says it all
                logger.warning("%s: not written: %s", name, describe(error))
        else:
            self._manifest.missing.pop(name, None)

    def leave_out(self, name: str, reason: str) -> None:
        """Note a part that a run which ends like this does not have."""
        self._manifest.missing[name] = reason

    def finish(self, write_page: Callable[[], object]) -> Status:
        """Complete the manifest, write the page from it, and say how the run ended, or raise what it failed of."""
        self._write_manifest()
        try:
            write_page()
        except Exception as error:
            self._manifest.missing["page"] = describe(error)
            if not self._is_like_failure(error):
                logger.warning("the page was not written: %s; all else is in %s", describe(error), self._folder)
            self._write_manifest()
        remove_parts(self._folder)
        return self._outcome()

    def give_up(self, fault: OSError) -> Status:
        """Write nothing, for the folder has gone: raise what the run failed of, or else that."""
        if self._failure is None:
            self._failure = fault
        return self._outcome()

    def _outcome(self) -> Status:
        if self._failure is None:
            return self._status
        if self._machine_failed():
            raise MachineError(self._line()) from self._failure
        raise self._failure

    def _write_manifest(self) -> None:
        def write() -> None:
            self._manifest.end(self._folder, self._status, None if self._failure is None else self._line())

        self.part("manifest", write)

    def _is_like_failure(self, error: Exception) -> bool:
        told, before = tell(error), None if self._failure is None else tell(self._failure)
        return told is not None and before is not None and told[1] == before[1]

    def _machine_failed(self) -> bool:
        # Nothing but files of the run folder is open by now, and that could be written to when the run began.
        return self._failure is not None and (isinstance(self._failure, OSError) or is_machine_fault(self._failure))

    def _line(self) -> str:
        assert self._failure is not None
        line = describe(self._failure)
        return f"{line}; {self._kept()}" if self._machine_failed() else line


def what_is_kept(folder: RunFolder, saved: int | None, done: int, parameters: bool) -> str:
    """What a reader will find of a run of `done` iterations that ends by the machine's fault, in words.

    `saved` is the number of iterations of the last state that it wrote (None: none), `parameters` says whether the
    values of its end were written; either may have been removed since.
    """
    if not folder.is_there:
        taken = "; what is there now is another's, and was left as it is" * folder.path.exists()
        return f"{folder.path} was removed or moved away{taken}"
    state = newest_checkpoint(folder.checkpoint)
    if saved is not None and state is not None:
        if state.name != STATE_FILE:
            return f"kept: an earlier state than that after {saved} of {done} iterations, in {state}"
        which = f"the state after {saved} of {done} iterations" if saved else "the initial state"
        return f"kept: {which}, in {folder.checkpoint}"
    if parameters and (folder.parameters / PARAMETERS_FILE_NAME).exists():
        return f"kept: the values after {done} iterations, in {folder.parameters}; no state to go on from"
    return "nothing of the run was kept"
