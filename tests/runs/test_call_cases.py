"""Results of functions about callbacks and log files, as a table of cases (`said.check`)."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from golden.cases import Cases, ending
from records.test_metrics import make_record

from reslrb_cli.runs import callbacks, log

Patch = pytest.MonkeyPatch
case = Cases()


@case
def calls_of_callbacks(patch: Patch) -> Any:
    """All callbacks are called in turn. Optional ones are dropped at an error, except at the begin."""
    heard: list[Any] = []
    lines: list[str] = []
    patch.setattr(callbacks.logger, "warning", lambda text, *given: lines.append(text % given))

    class Kept(callbacks.Callback):
        def __init__(self, name: str, fails: str = "", optional: bool = False) -> None:
            self.name, self.fails, self.optional = name, fails, optional

        def _hear(self, what: str, *given: Any) -> None:
            heard.append([self.name, what, *given])
            if what == self.fails:
                raise ValueError(f"{self.name} at {what}")

        def begin(self, run: Any) -> None:
            self._hear("begin", run)

        def iteration(self, run: Any, record: Any) -> None:
            self._hear("iteration", record.iteration)

        def image(self, run: Any, name: str, image: Any, exposure: float) -> None:
            self._hear("image", name, float(image.sum()), exposure)

        def end(self, run: Any, status: str) -> None:
            self._hear("end", status)

    raising = f"in line {Kept._hear.__code__.co_firstlineno + 3} "

    def in_place(text: Any) -> Any:
        return text.replace(raising, "in its place ") if isinstance(text, str) else text

    views = [{"sensor": 0, "shown": 2.0}, {"sensor": 3, "shown": 0.5}]
    found = []
    for fails in ("", "begin", "iteration", "image", "end"):
        for optional in (False, True):
            listeners = [Kept("a", fails, optional), Kept("b")]
            made = callbacks.Calls(listeners, "run", SimpleNamespace(views=views))  # type: ignore[arg-type]
            pixels = {0: np.ones((1, 2, 3)), 3: np.zeros((1, 2, 3))}
            acts = (
                made.begin,
                partial(made.iteration, make_record(iteration=2)),
                partial(made.images, "final", pixels),
                partial(made.images, "target", {3: pixels[0]}),
                partial(made.iteration, make_record(iteration=3)),
                partial(made.end, "failed"),
            )
            ends = [in_place(ending(act)) for act in acts]
            found.append([fails, optional, ends, bool(made), heard.copy(), [*map(in_place, lines)]])
            heard.clear()
            lines.clear()
    return found, bool(callbacks.Calls([], "run", None))  # type: ignore[arg-type]


@case
def collected_lines(patch: Patch) -> Any:
    """Lines of each level, with and without handlers of the program, and in blocks that fail."""
    shown: list[str] = []
    own = logging.getLogger("reslrb_cli")
    root = logging.getLogger()
    patch.setattr(log, "now", lambda: "now")
    found = []
    for has_handlers in (False, True):
        for level in (logging.WARNING, logging.INFO):
            last = logging.Handler(level)
            last.emit = lambda record: shown.append(record.getMessage())  # type: ignore[method-assign]
            patch.setattr(logging, "lastResort", last)
            handlers, before = root.handlers.copy(), own.level
            root.handlers[:] = [logging.NullHandler()] if has_handlers else []
            kept, own.handlers[:] = own.handlers.copy(), []
            own.setLevel(logging.DEBUG)
            with pytest.raises(ZeroDivisionError), log.collected() as lines:
                _tell_all(own)
            own.warning("after")
            found.append([has_handlers, level, lines, shown.copy(), own.handlers == []])
            shown.clear()
            root.handlers[:], own.handlers[:] = handlers, kept
            own.setLevel(before)
    return found


def _tell_all(logger: logging.Logger) -> None:
    """Log a line of each level, then fail."""
    for level in ("debug", "info", "warning", "error"):
        getattr(logger, level)(f"a {level}\nb")
    raise ZeroDivisionError


@case
def appended_lines(patch: Patch) -> Any:
    found = []
    for is_there in (True, False):
        folder: Any = SimpleNamespace(path=Path(), is_there=is_there)
        for lines in ([], ["a"], ["b", "ä \udcff"]):
            log.append_log(folder, lines)
            found.append(Path("run.log").read_text() if Path("run.log").exists() else None)
    gone: Any = SimpleNamespace(path=Path("gone"), is_there=True)
    return [*found, log.append_log(gone, ["c"])]  # type: ignore[func-returns-value]


test_cases = pytest.mark.usefixtures("llvm")(case.test())
