"""The course of a run: what its iterations go on from, and what has been found on the way; kept, and taken up again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.optimization import Problem
from reslrb_cli.optimization.best import Best
from reslrb_cli.optimization.certainty import Certainty
from reslrb_cli.optimization.results import Results
from reslrb_cli.optimization.state import State
from reslrb_cli.optimization.stored import Stored, stored_value
from reslrb_cli.records.checkpoint import save_checkpoint
from reslrb_cli.records.metrics import Record, finite
from reslrb_cli.records.tally import ClampTally, NonFiniteTally

Array = np.ndarray[Any, Any]


class Course:
    """Of one run of `problem`, whose parameters stand at their initial values when this is made.

    `fixed` are plain values that go into every checkpoint: by them another process assembles the same problem.
    """

    def __init__(self, problem: Problem, fixed: Mapping[str, Any]) -> None:
        self.problem, self._fixed = problem, dict(fixed)
        self.state, self.results = State(problem), Results(problem)
        self.certainty = Certainty(problem)
        self.best = Best(any(view.held_out for view in problem.views))
        self.nonfinite, self.clamped = NonFiniteTally(), ClampTally()
        self.last: Record | None = None
        self._snapshot = self.state.capture()
        #: The values of the start, in the host's memory.
        self._initial: dict[str, Array] = {}
        for key, value in self._snapshot.moved.items():
            self._initial |= stored_value(problem, "initial", key, value)
        self.results.begin()

    @property
    def done(self) -> int:
        """The number of finished iterations."""
        return 0 if self.last is None else self.last.iteration + 1

    def add(self, record: Record) -> None:
        """Take one iteration, of which `state` is what it leaves."""
        self.best.see(record, self._snapshot.moved)
        self._take(record)
        self.certainty.see(self.done)
        self._snapshot = self.state.capture()

    def _take(self, record: Record) -> None:
        self.last = record
        self.results.add(record)
        self.nonfinite.add(record)
        self.clamped.add(record)

    def learned(self) -> tuple[dict[str, int] | None, dict[str, Array]]:
        """What guided emission knew before the iteration that is at work, which may have taught it more by now.

        That is the number of gradients by sensor, and arrays by `<sensor>/<what>`; None and nothing where it is off.
        """
        prefix = "guiding/"
        arrays = {name.removeprefix(prefix): a for name, a in self._snapshot.arrays.items() if name.startswith(prefix)}
        return self._snapshot.values.get("guiding"), arrays

    def best_values(self) -> dict[str, Array]:
        """The best parameters so far, as `problem.values()` has them; nothing where there are none yet."""
        shown = self.problem.selection.shown
        return {
            key: value if isinstance(value, np.ndarray) else shown(key, value)
            for key, value in self.best.values.items()
        }

    # --- kept and taken up again --------------------------------------------------------------------------------------

    def save(self, folder: Path) -> int:
        """Keep it in `folder` as it was after its last whole iteration; return how many it had. Raises OSError."""
        problem, snapshot = self.problem, self._snapshot
        others = snapshot.others(problem) | self._initial
        others |= {f"best/{key}": value for key, value in self.best_values().items()}
        others |= {f"mask/{key}": mask for key, mask in problem.masks.items()}
        seen, squares = self.certainty.state()
        others |= {f"squares/{key}": np.array(value) for key, value in squares.items()}
        best = self.best.to_json()
        values = self._fixed | snapshot.values
        values |= {
            "best": best and {"iteration": best["iteration"], "loss": best["loss"]},
            "images": self.results.images_seen(),
            "certainty": {"seen": seen, "keys": list(squares)},
            "last": None if self.last is None else asdict(self.last),
        }
        save_checkpoint(folder, snapshot.iteration, snapshot.parameters(problem), others, finite(values))
        return snapshot.iteration

    def restore(self, stored: Stored, records: Sequence[Record]) -> None:
        """Go on from what was stored, and from the records of all iterations until then.

        Raises ConfigError, located in the file, where something there is not what this run can have left.
        """
        problem = self.problem
        self.state.restore(stored)
        for record in records:
            self._take(record)
        self.best.recall(list(records))
        if stored.value("best") is not None:
            values = {
                key: stored.archive.array(f"best/{key}", problem.selection.array(key).shape, "f")
                for key in problem.selection.keys
            }
            for key, array in values.items():
                stored.check_bounds(problem, f"best/{key}", key, array)
            self.best.restore(stored.count("best", "iteration", least=0), stored.number("best", "loss"), values)
        self.results.recall({name: stored.numbers("images", name) for name in ("trained", "held_out")})
        squares = {}
        for key in stored.texts("certainty", "keys"):
            kept = problem.optimizer.squares(key) if key in problem.selection.keys else None
            if kept is not None:
                squares[key] = stored.take(f"squares/{key}", kept[0])
        self.certainty.restore(stored.count("certainty", "seen", least=0), squares)
        self._snapshot = self.state.capture()
