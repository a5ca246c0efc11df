"""Optimisation in the loop of a script, with or without a run folder."""

from __future__ import annotations

import atexit
import contextlib
import functools
import logging
import os
import signal
import sys
import threading
import weakref
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from inspect import GEN_CLOSED, getgeneratorstate
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from reslrb_cli.api.experiment import KILLING, Experiment, Scene, called, end_by, held, interrupted, load_with
from reslrb_cli.backend.variant import keep_variant
from reslrb_cli.config.files import as_path
from reslrb_cli.config.loader import OVERRIDDEN, Override, overrides_of
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, describe
from reslrb_cli.optimization.loop import iterate
from reslrb_cli.optimization.problem import progress_spp
from reslrb_cli.optimization.uncertainty.fit import FitRecord
from reslrb_cli.records.manifest import Status
from reslrb_cli.records.metrics import Record
from reslrb_cli.records.run_folder import check_output
from reslrb_cli.report.run_summary import descriptions
from reslrb_cli.runs.callbacks import Callback
from reslrb_cli.runs.loggers import Callbacks, callbacks_of
from reslrb_cli.runs.prepare import PreparedRun, begin, with_freed
from reslrb_cli.runs.recorder import Recording
from reslrb_cli.runs.resume import open_earlier

if TYPE_CHECKING:
    import mitsuba as mi

Array: TypeAlias = "np.ndarray[Any, np.dtype[np.float32]]"
Folder: TypeAlias = "str | os.PathLike[str]"
#: `loss(image, target)` or `loss(image, target, weights)`.
Loss: TypeAlias = (
    "Callable[[mi.TensorXf, mi.TensorXf], mi.Float | mi.TensorXf]"
    " | Callable[[mi.TensorXf, mi.TensorXf, mi.TensorXf | None], mi.Float | mi.TensorXf]"
)

logger = logging.getLogger(__name__)

#: Runs in a loop, and resumed runs before their loop. Both hold the locks of their folders.
_looping: weakref.WeakSet[Run] = weakref.WeakSet()
_waiting: weakref.WeakSet[Run] = weakref.WeakSet()


@contextlib.contextmanager
def _completed_at_the_end(run: Run) -> Iterator[None]:
    """While the block runs, let signals that would kill the script end it as `sys.exit` does. The end of the script
    completes the run's folder.
    """
    is_main = threading.current_thread() is threading.main_thread()  # no other thread can set handlers
    _looping.add(run)
    for number in KILLING if is_main else ():
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, end_by)
    try:
        yield
    finally:
        _looping.discard(run)
        for number in KILLING if is_main and not _looping else ():
            if signal.getsignal(number) is end_by:
                signal.signal(number, signal.SIG_DFL)


@atexit.register
def _leave_loops() -> None:
    """Complete the folders of runs whose iterators are still open at the end of the script."""
    for run in list(_looping):
        with contextlib.suppress(Exception):  # it is logged, and the script has ended
            run.close()


class Run:
    """Optimisation that computes one iteration at a time. `optimize` returns a `Run`.

    Iterate over a run to compute its iterations. Each iteration yields its `Record`, which is also a line of
    `metrics.jsonl`.

    A run stops when you leave the loop (`break` or an error), at the end of a `with` block, and on `close`. The folder
    of a stopped run is complete, as after Ctrl-C on the command line. The folder holds manifest, checkpoint,
    parameters, final images and report, and its lock is released. A second loop continues where the first one stopped.
    An interrupt (Ctrl-C, a notebook's stop button) ends the loop after the current iteration. SIGTERM and SIGHUP then
    also end the script, with the exit code 143 or 129. The end of the script completes the folder of an open iterator.

    Runs in one process share only the device. You can alternate between them: `zip(run_a, run_b)`. Runs in different
    threads take turns, one iteration at a time. A run and its loop belong to one thread.
    """

    def __init__(
        self, stack: contextlib.ExitStack, begun: PreparedRun, writes: bool, callbacks: Sequence[Callback] = (),
        folder: Path | None = None,
    ) -> None:  # fmt: skip
        self._begun, self._writes, self._stack, self._callbacks = begun, writes, stack, callbacks
        self._records: list[Record] = []
        self._folder = folder
        done = begun.course.done >= self.config.run.iterations and not writes
        self._status = Status.FINISHED if done else Status.RUNNING
        self._stopped = False
        self._failure: BaseException | None = None
        self._loop: weakref.ref[Generator[Record, None, None]] | None = None
        self._uses = self._scene_uses()
        self._thread = threading.current_thread()
        if folder is not None and writes:
            _waiting.add(self)

    # --- iterating ----------------------------------------------------------------------------------------------------

    def __iter__(self) -> Generator[Record, None, None]:
        loop = None if self._loop is None else self._loop()
        if loop is not None and getgeneratorstate(loop) != GEN_CLOSED:  # a traceback can keep a closed loop alive
            raise RuntimeError("this run is in a loop already; leave that first")
        loop = self._iterations()
        self._loop = weakref.ref(loop)
        return loop

    def _iterations(self) -> Generator[Record, None, None]:
        if threading.current_thread() is not self._thread:  # Dr.Jit would end the process
            raise RuntimeError("this run was made in another thread; call optimize in the thread of its loop")
        made = self._made()
        _waiting.discard(self)
        with _completed_at_the_end(self):
            try:
                while True:
                    if self._scene_uses() != self._uses:
                        reason = "has been used by another run or call since; load it once for each run"
                        raise ConfigError("scene", "", reason)
                    self._check_variant()
                    with held():
                        record = next(made, None)
                    if record is None:
                        return
                    self._records.append(record)
                    yield record
            except GeneratorExit:
                # Python discards an exception raised while the loop is left, so `close` raises it.
                try:
                    with held():
                        made.close()
                except Exception as error:
                    self._failure = error
                    logger.error("%s", describe(error))
            finally:
                with held():
                    made.close()
                    if self.config.own_scene is not None:
                        self._leave_values()

    def _check_variant(self) -> None:
        now, own = sys.modules["mitsuba"].variant(), self._begun.manifest.variant
        if now != own:
            reason = f"is {own}, but the script has set {now} during the loop; set {own} again before it continues"
            raise ConfigError(self.config.source, "variant", reason)

    def _scene_uses(self) -> int:
        own = self.config.own_scene
        return 0 if own is None else int(own.uses)

    def _leave_values(self) -> None:
        """Give the caller's scene the current values without derivatives."""
        problem = self._begun.course.problem
        problem.selection.hand_over({key: dr.detach(problem.optimizer[key]) for key in problem.selection.keys})
        problem.optimizer.stands_at = None  # so that another loop hands its values over again

    def _made(self) -> Generator[Record, None, None]:
        """Yield the records of the remaining iterations, and write them if the run has a folder."""
        if self._stopped and self._writes and self._folder is not None:
            with called():
                self._stack, self._begun, self._writes, _ = _reopened(  # also restores a scene in memory
                    self._folder, (), self.config.own_loss, self.config.allows_code, lambda _: self._callbacks,
                    self.config.own_scene,
                )  # fmt: skip
                self._uses = self._scene_uses()
        self._stopped, self._status, self._failure = True, Status.RUNNING, None
        course = self._begun.course
        with self._stack:
            if not self._writes:
                yield from self._unwritten()
                return
            with self._begun.place() as place:
                self._folder = place.path
                calls = self._begun.calls(self._callbacks, place.path)
                recording = Recording(course, place, self._begun.manifest, calls, self._begun.said)
                try:
                    yield from recording.records(interrupted)
                    for line in self._begun.manifest.results.get("warnings") or ():
                        logger.warning("%s", line)  # a script prints no last line, as the command does
                finally:
                    self._status = Status(self._begun.manifest.status)

    def _unwritten(self) -> Generator[Record, None, None]:
        course, status = self._begun.course, Status.FAILED
        calls = self._begun.calls(self._callbacks, None)
        try:
            calls.begin()
            if calls and not course.done:
                calls.images("target", self.targets)
                calls.images("initial", self.images)
            told = functools.partial(logger.warning, "%s")
            for state, record in iterate(course.problem, course.state, told):
                course.add(state, record)
                calls.iteration(record)
                yield record
            if calls:
                calls.images("final", self.images)
            status = Status.FINISHED
        except (GeneratorExit, KeyboardInterrupt):
            is_done = course.done >= self.config.run.iterations or bool(course.state.stopped)
            status = Status.FINISHED if is_done else Status.INTERRUPTED
            raise
        finally:
            course.stand()
            self._status = Status.FAILED
            calls.end(status.value)
            self._status = status

    def live(self) -> Iterator[Record]:
        """Iterate with a progress bar of `tqdm.auto`, which is a widget in a notebook with `reslrb[notebook]`."""
        from tqdm.auto import tqdm

        total, meter = self.config.run.iterations, self._begun.course.problem.meter
        with contextlib.closing(iter(self)) as records, tqdm(total=total, initial=self.iteration, unit="it") as bar:
            for record in records:
                bar.set_description_str(descriptions(record, meter)[-1], refresh=False)
                bar.update()
                yield record

    def close(self) -> None:
        """Stop the run and complete its folder. Does nothing if no loop is active.

        `close` raises an error if the folder cannot be completed. `close` also raises an error that occurred while an
        earlier loop was left. If the folder cannot be written to, the error is a MachineError.
        """
        loop = None if self._loop is None else self._loop()
        if loop is not None:
            loop.close()
        self._release()
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _release(self) -> None:
        """Release the lock of a resumed run before its loop. The loop then opens the folder again."""
        self._stack.close()
        if self in _waiting:
            _waiting.discard(self)
            self._stopped = True

    def __enter__(self) -> Run:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.close()
        except Exception:
            if error is None:  # otherwise it is logged already, and the error of the block says more
                raise

    # --- looking ------------------------------------------------------------------------------------------------------

    @property
    def config(self) -> Config:
        """The experiment, with all defaults filled in."""
        return self._begun.course.problem.config

    @property
    def folder(self) -> Path | None:
        """The run folder. The folder is None before the first loop, because the first loop creates the folder. The
        folder is always None for a run that writes nothing.
        """
        return self._folder

    @property
    def status(self) -> str:
        """The run's status: `running` until a loop ends, then `finished`, `interrupted` or `failed`."""
        return self._status.value

    @property
    def iteration(self) -> int:
        """The number of completed iterations, including those before a `resume`."""
        return self._begun.course.done

    @property
    def records(self) -> list[Record]:
        """The records of the iterations that this process has computed, oldest first."""
        return list(self._records)

    @property
    def parameters(self) -> dict[str, Array]:
        """The parameter values after the last complete iteration, by key.

        Values are float32, in the units of the parameters. Shapes: texture (height, width, channels), colour
        (channels,), number (), vertices (count, 3).
        """
        with held():
            return self._begun.course.values()

    @property
    def gradients(self) -> dict[str, Array]:
        """The gradients of the last iteration, by key. The result is empty before the first iteration.

        Each gradient has the shape of its parameter. Gradients include regularizers. Gradients may contain values that
        are not finite.
        """
        course = self._begun.course
        with held():
            return course.shown(course.state.gradients)

    @property
    def images(self) -> dict[int, Array]:
        """The current image of each view, by sensor index.

        Images are float32 arrays (height, width, channels) with the exposure of the target. Each access renders the
        images with separate seeds, so an access does not change the run. The images have at least 64 samples per pixel,
        as many as the images saved between iterations. Raises the same errors as a run, such as ConfigError.
        """
        course = self._begun.course
        problem = course.problem
        with held():
            course.stand()
            spp = progress_spp(problem)
            seen = {view.sensor: view.shown_array(problem.render(view.sensor, spp, course.done, "saved image"))
                    for view in problem.views}  # fmt: skip
        return seen

    @property
    def targets(self) -> dict[int, Array]:
        """The target of each view, by sensor index: float32 arrays (height, width, channels) without alpha."""
        with held():
            return {view.sensor: np.array(view.target) for view in self._begun.course.problem.views}

    @property
    def truth(self) -> dict[str, Array]:
        """The true parameter values, by key. True values are known if the target is rendered, or if `target.truth` is
        set.
        """
        return dict(self._begun.course.problem.truth)

    def unexplained(self) -> FitRecord | None:
        """Return the result of the test of fit, with further parameters that would reduce a misfit of the model.

        The record has the attributes of `certainty.fit` in the manifest. `is_significant` is true if noise does not
        explain the difference between the images and their targets. `misfit` is the size of the difference, as a share
        of the targets. `p` is the probability that noise causes as large a difference. `candidates` are the parameters,
        the most effective one first. Each has `key`, `p`, `explained` (its share of the misfit), `value`, `proposed`
        and `bounds`. The method `to_json()` returns the whole record as a dictionary.

        A run with a folder has this record at its end. Otherwise, each call makes the measurement that ends a run
        with a folder. A call does not change the run. The result is None after fewer than 20 iterations, and if the
        loss does not judge each pixel apart.
        """
        course, measured = self._begun.course, self._begun.manifest.results.get("certainty")
        if measured is not None and measured.get("fit") is not None:
            return FitRecord.from_json(measured["fit"])
        if course.last is None or not self.config.by_pixel:
            return None
        with held():
            course.stand()
            found = course.certainty.measure(course.done, course.last.elapsed_s, interrupted)
        return None if found is None else found.fit

    def __repr__(self) -> str:
        where = "" if self._folder is None else f", {self._folder}"
        return f"<Run {self.config.source}: {self.iteration} of {self.config.run.iterations}, {self.status}{where}>"


def optimize(
    experiment: Experiment | None = None,
    folder: Folder | None = None,
    resume: Folder | None = None,
    overrides: Mapping[str, object] | None = None,
    loss: Loss | None = None,
    allow_code: bool = False,
    scene: Scene | None = None,
    callbacks: Callbacks = (),
    free: Sequence[str] = (),
) -> Run:
    """Recover the parameters of an experiment; returns a `Run`, which computes one iteration at a time.

        with rl.optimize("configs/cornell_floor.yaml", folder="runs/carpet") as run:
            for record in run:
                print(record.iteration, record.loss)
        texture = run.parameters["floor.reflectance.data"]

    `experiment` and `overrides` are the arguments of `load`. `experiment` may also be a result of `load`.

    `folder` is the run folder. The content is the same as from `reslrb optimize`. If `folder` exists, the run is
    written to `folder-2` and so on (see `Run.folder`). With `folder`, the setting `run.output` is ignored.
    Without `folder`, only the caches of kernels and measurements are written.

    `resume` is the folder of an earlier run, in place of `experiment` and `folder`. The run continues exactly where the
    earlier run stopped. `overrides` may change iterations and learning rates. A finished run has no iterations left and
    logs a warning.

    `loss` is your own loss function, `loss(image, target)` or `loss(image, target, weights)`. The arguments are
    `mi.TensorXf` (height, width, channels). The image tracks derivatives. The loss function returns a `mi.Float` of
    width 1 or a tensor with one entry. Pass it again with `resume`. `allow_code` permits running the code files that
    the experiment names (`loss.file`, `integrator.file`, `run.callbacks`).

    `scene` replaces the scene of the experiment: a dictionary as for `mi.load_dict`, or an `mi.Scene` (see `load`). At
    the end of a loop, an `mi.Scene` has the recovered values, without derivatives. Only one run at a time can use it,
    and the run cannot be resumed from its folder.

    `callbacks` receive the progress of the run (`Callback`), after those of `run.callbacks`. The names `"tensorboard"`,
    `"mlflow"` and `"wandb"` stand for `TensorBoard()`, `MLflow()` and `WandB()`.

    `free` names further parameters of the scene to recover, by the keys that `reslrb inspect` lists. They start at the
    values of the scene, within their usual bounds. If `experiment` is a run folder, the other parameters start from the
    values that the run has reached.

    Before returning, `optimize` sets the experiment's Mitsuba variant if none is set. `optimize` loads and checks all
    files and makes the target. `optimize` also chooses the settings that the experiment leaves to measurement. Raises
    ConfigError (located by file and key), UnsupportedScene, BackendError and MachineError. Iterating can also raise
    NonFinite and OutOfMemory.
    """
    put_in, named, keys = overrides_of(overrides), list[Override](), [free] if isinstance(free, str) else list(free)
    if folder is not None:
        path = Path(os.path.abspath(as_path(folder, "folder", "the path of a folder")))
        for key in ("output", "name"):
            if any(one.location == ("run", key) for one in put_in):
                raise ConfigError(OVERRIDDEN, f"run.{key}", "is what folder says; leave one of them out")
        named = [
            Override("folder", ("run", "output"), str(path.parent)),
            Override("folder", ("run", "name"), path.name),
        ]
    with called():
        if resume is not None:
            if folder is not None:
                raise ConfigError("folder", "", "cannot be given with resume; copy the folder, and resume the copy")
            if experiment is not None:
                raise ConfigError("experiment", "", "cannot be given with resume, which uses that of the run")
            if scene is not None:
                raise ConfigError("scene", "", "cannot be given with resume, which uses that of the run")
            if keys:
                reason = f"starts a new run, resume continues one; give experiment={str(resume)!r} in place of resume"
                raise ConfigError("free", "", reason)
            earlier = as_path(resume, "resume", "the folder of a run")
            listen = functools.partial(callbacks_of, more=callbacks, source="callbacks")
            folder = Path(os.path.abspath(earlier))
            for run in list(_waiting):  # of a notebook's cell that was run before
                if run.folder == folder:
                    run._release()
            return Run(*_reopened(earlier, put_in, loss, allow_code, listen), folder)
        if experiment is None:
            raise ConfigError("experiment", "", "is missing; give a configuration, or resume=RUN")
        config = _with_own(load_with(experiment, [*put_in, *named], scene=scene), loss, allow_code)
        if folder is not None:
            try:
                check_output(config.source, config.run.output)
            except ConfigError as error:
                raise ConfigError("folder", "", error.message) from None
        variant = keep_variant(config.variant, config.source)
        config = with_freed(config, keys, "free")
        listeners = callbacks_of(config, callbacks, "callbacks")
        begun = begin(config, variant, logger.info, logger.warning, "" if folder is None else path.name, interrupted)
        return Run(contextlib.ExitStack(), begun, folder is not None, listeners)


def _with_own(config: Config, loss: Loss | None, allow_code: bool) -> Config:
    """Return the experiment with the caller's loss. If `allow_code` is set, the experiment's code may run."""
    config = config.with_code(allow_code or config.allows_code)
    if loss is not None and not callable(loss):
        reason = "is no function; a file's is named by the setting `loss: {type: custom, file: FILE.py:NAME}`"
        raise ConfigError("loss", "", reason)
    return config if loss is None else config.with_loss(loss)


def _reopened(
    folder: Path, put_in: Sequence[Override], loss: Loss | None, allow_code: bool,
    listen: Callable[[Config], Sequence[Callback]], scene: Any = None,
) -> tuple[contextlib.ExitStack, PreparedRun, bool, Sequence[Callback]]:  # fmt: skip
    """Return the lock stack, the prepared run to resume, True if iterations are left, and the callbacks that `listen`
    makes for its configuration. The stack holds the lock of the run folder.
    """
    with contextlib.ExitStack() as stack:
        earlier = stack.enter_context(open_earlier(folder, put_in))
        earlier.config = _with_own(earlier.config, loss, allow_code).with_scene(scene)
        variant = keep_variant(earlier.settled.variant, earlier.config.source)
        listeners = listen(earlier.config)
        begun = earlier.begin(variant, logger.info, logger.warning)
        if earlier.is_done:
            logger.warning("%s", earlier.done_line("the override", ": "))
        kept = contextlib.ExitStack() if earlier.is_done else stack.pop_all()
        return kept, begun, not earlier.is_done, listeners
