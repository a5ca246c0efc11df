"""The shards of a run's steps on workers (`calls.Workers`), and the data that workers need to compute the shards.

Workers read the files of the experiment at the same paths as the run, and compare their digests. The run sends its
state before the first iteration, and its targets.

A call depends only on the experiment, on parameter values and tables (`Standing`), on the shard, and on the shard's
dL/dI. It returns NumPy arrays. The result does not depend on the worker, on repetitions, or on the number of workers.
Optimiser, checkpoints and page stay in the process of `optimize`.

The module imports dask, so it is imported only for `--cluster`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from reslrb_cli.backend.variant import set_variant
from reslrb_cli.cluster.calls import Workers, Workload
from reslrb_cli.cluster.connection import Cluster, connected
from reslrb_cli.config.loader import loads
from reslrb_cli.errors import MachineError
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.optimization.memory import check_step
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.shards import Task, make_tasks, shard_gradient, shard_image
from reslrb_cli.optimization.state import Settled, begin_as, decide_as, guiding_of, restore_tables
from reslrb_cli.optimization.views import set_targets, target_arrays
from reslrb_cli.records.checkpoint import STATE_FILE, write_archive
from reslrb_cli.records.tree import Stored, like, to_array
from reslrb_cli.runs.prepare import RunProgress, check_files

Array = np.ndarray[Any, Any]

#: File of the targets of the views.
TARGETS_FILE = "targets.npz"


@dataclass(frozen=True)
class Standing:
    """Parameters and tables of a step. The values are those of the optimiser. The tables are the guide's learned state
    (`Guiding.state`).
    """

    values: dict[str, Array]
    calls: dict[str, int]
    learned: dict[str, Array]

    @staticmethod
    def of(problem: Problem) -> Standing:
        """Return the current parameters and tables of a problem."""
        guiding = guiding_of(problem)
        calls, learned = ({}, {}) if guiding is None else guiding.state()
        keys = problem.optimizer.keys()
        values = {key: to_array(problem.optimizer[key]) for key in keys}
        return Standing(values, dict(calls), learned)

    def take(self, problem: Problem) -> None:
        """Set the parameters and tables of a problem."""
        for key, value in self.values.items():
            problem.optimizer.set_value(key, like(dr.detach(problem.optimizer[key]), value))
        wrong = restore_tables(problem, self.calls, self.learned)
        if wrong is not None:
            raise MachineError(f"a worker has other guiding tables than the run: {wrong}")
        problem.apply()


# --- on a worker ------------------------------------------------------------------------------------------------------


def assembled(folder: Path, threads: int | None, allows_code: bool) -> tuple[Problem, dict[str, float]]:
    """Load the run's problem from the experiment's files and the run's state and targets in `folder`, and compile the
    problem's kernels.

    Also returns the time of each shard function after compilation, in seconds.
    """
    stored = Stored(folder / STATE_FILE)
    settled = stored.read(Settled)
    config = loads(settled.config, stored.path)
    check_files(settled.files, config)
    with np.load(folder / TARGETS_FILE) as targets:
        set_variant(settled.variant)
        problem = assemble_scene(config.with_code(allows_code))
        begin_as(problem, stored)
        check_step(problem)
        problem = decide_as(problem, stored)
        set_targets(problem.views, dict(targets))
    if threads is not None:
        dr.sync_thread()
        dr.set_thread_count(threads)
    return problem, _warmed(problem)


def _warmed(problem: Problem) -> dict[str, float]:
    """Compile and record the kernels of a step's shards. Returns the time of each function without compilation, in
    seconds.
    """
    task = make_tasks(problem, 0)[0]
    calls: list[tuple[Callable[..., Any], tuple[Task | Array, ...]]] = [(shard_gradient, (task,))]
    if problem.config.in_rounds:
        image = shard_image(problem, task)
        calls = [(shard_image, (task,)), (shard_gradient, (task, np.zeros_like(image)))]
    found = {}
    for function, given in calls:
        for _ in range(3):  # compiled, recorded, replayed
            begin = time.perf_counter()
            function(problem, *given)
            found[function.__name__] = time.perf_counter() - begin
    return found


# --- in the process that runs `optimize` ------------------------------------------------------------------------------


def workload_of(course: RunProgress, folder: Path, threads: int | None, own: bool) -> Workload:
    """Return the data that workers need for a run. `own`: the workers belong to this run. `folder` is for temporary
    files.

    Raises OSError. Raises ConfigError if a file has changed since the run began.
    """
    config = course.problem.config
    check_files(course.files, config)
    course.save(folder)
    write_archive(folder / TARGETS_FILE, target_arrays(course.problem.views))
    files = {name: (folder / name).read_bytes() for name in (STATE_FILE, TARGETS_FILE)}
    allows_code = config.allows_code
    return Workload(files, assembled, (allows_code,), threads, asks_for_code=allows_code and not own)


@contextlib.contextmanager
def engine_at(course: RunProgress, place: Cluster, threads: int | None = None) -> Iterator[Workers]:
    """Load a run's experiment on the workers at `place`, and provide the workers as an `Engine`. Each worker has
    `threads` threads. If `threads` is None, each worker of this machine gets its share of the cores.

    Raises MachineError if there are no usable workers.
    """
    with connected(place) as (client, folder):
        workload = workload_of(course, folder, threads or place.threads, own=place.address is None)
        yield Workers(client, workload, Standing.of)
