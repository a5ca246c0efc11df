"""The recording of a run: its optimisation is run, and its folder written; one that is resumed goes on where it was.

- `Recording`: one run being recorded.
- `Ending`: the end of a run, part by part. Each stands alone, the manifest comes first, and it says what is missing.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.errors import MachineError, NonFinite, describe, is_machine_fault, tell
from reslrb_cli.optimization.loop import iterate
from reslrb_cli.optimization.nonfinite import Findings
from reslrb_cli.optimization.problem import Problem, saved_spp
from reslrb_cli.optimization.sensitivity import curvature_line, step_line
from reslrb_cli.optimization.state import State, noted_of
from reslrb_cli.optimization.uncertainty.measuring import LEAST_ITERATIONS
from reslrb_cli.optimization.uncertainty.verdicts import CertaintyRecord
from reslrb_cli.records.atomic import Reserve, remove_parts, size_of
from reslrb_cli.records.checkpoint import (
    NONFINITE_FILE_NAME,
    STATE_FILE,
    NonFiniteStep,
    newest_checkpoint,
    save_nonfinite,
)
from reslrb_cli.records.decisions import Scaled
from reslrb_cli.records.images import PARAMETERS_FILE as PARAMETERS_FILE_NAME
from reslrb_cli.records.images import load_image, write_image, write_mask, write_parameters
from reslrb_cli.records.manifest import NOT_YET, Manifest, Status
from reslrb_cli.records.measurement_files import LivePage
from reslrb_cli.records.measurements import incomplete_records
from reslrb_cli.records.metrics import MetricsWriter, Record, finite
from reslrb_cli.records.run_folder import FABRICATION_FILE, RunFolder
from reslrb_cli.report.page import write_report
from reslrb_cli.report.perceptual import seen_errors
from reslrb_cli.report.run_summary import warnings
from reslrb_cli.report.tonemap import shown_exposures, write_error_map
from reslrb_cli.runs.prepare import Course

logger = logging.getLogger(__name__)


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


#: Images with more pixels take some seconds to be compared, and that is said.
MANY_PIXELS = 5e5

#: What the end of a run writes beside checkpoint and parameters, for which room is kept: a manifest, and lists.
RESERVE_BYTES = 1 << 16


@dataclass
class Recording:
    """One run being recorded: `course` is what it has come to, from where it began or was gone on with."""

    course: Course
    folder: RunFolder
    manifest: Manifest
    page: LivePage = field(init=False)
    error_maps: dict[str, Any] = field(default_factory=dict)
    seen: dict[str, Any] = field(default_factory=dict)
    certainty: CertaintyRecord | None = None
    #: How the run ended, once it has.
    status: Status = Status.RUNNING
    _saved_nonfinite: bool = field(init=False)
    #: Iterations that the newest checkpoint contains; None before the first one.
    _saved: int | None = None

    def __post_init__(self) -> None:
        self._stop: Callable[[], bool] = lambda: False
        self._saved_nonfinite = (self.folder.checkpoint / NONFINITE_FILE_NAME).exists()
        self.page = LivePage(self._write_live_page)

    @property
    def problem(self) -> Problem:
        """What is optimised."""
        return self.course.problem

    @property
    def done(self) -> int:
        """The number of finished iterations."""
        return self.course.done

    def run(self, show: Callable[[Record], None], stop: Callable[[], bool]) -> Status:
        """Iterate until the end or until `stop()`, and complete the folder; return how it ended (`records`).

        What `show` fails of is what the run fails of.
        """
        records = self.records(stop)
        for record in records:
            try:
                show(record)
            except BaseException as error:
                with contextlib.suppress(StopIteration):
                    records.throw(error)
        return self.status

    def records(self, stop: Callable[[], bool] = lambda: False) -> Generator[Record, None, None]:
        """The record of each iteration until the end, until `stop()`, or until nobody asks for more (`close`); then
        the folder is completed, and `status` says how the run ended.

        Whatever ends the run, its folder has a manifest that says so, the parameters, a checkpoint and the report, and
        final images where it did not fail; what could not be written is noted in the manifest. Raises what the run
        failed of, a MachineError where the folder could not be written to.
        """
        self._stop = stop
        reserve = Reserve(self.folder.checkpoint)
        status: Status = Status.FAILED
        failure: BaseException | None = None
        try:
            self.page.refresh()
            values = self.folder.parameters
            if self.done:  # what `_begin` writes is there: a run has a state after an iteration only then
                self._saved = self.done
            else:
                self._begin()
                values = values / "initial"
            # the state at the end has the best values too, and what the clamp and the optimiser then know
            reserve.hold(2 * size_of(self.folder.checkpoint) + size_of(values) + RESERVE_BYTES)
            (self.folder.path / FABRICATION_FILE).unlink(missing_ok=True)  # of where it was before it went on
            yield from self._iterate(stop)
            left = self.done < self.problem.config.run.iterations and not self.course.state.stopped
            status = Status.INTERRUPTED if left else Status.FINISHED
        except GeneratorExit:
            left = self.done < self.problem.config.run.iterations and not self.course.state.stopped
            status = Status.INTERRUPTED if left else Status.FINISHED
        except KeyboardInterrupt:
            self.course.stand()
            status = Status.INTERRUPTED
        except NonFinite as error:
            failure = NonFinite(f"{error}; {self._where()}") if self._saved_nonfinite else error
        except BaseException as error:
            failure = error
        reserve.release()
        self.status = self._end(status, failure)

    def abandon(self) -> None:
        """Note in the manifest that the run was interrupted, in a process that is about to end in the midst of it."""
        if not self.manifest.results and self.course.last is not None:
            self.manifest.results = {"iterations": self.done, "elapsed_s": self.course.last.elapsed_s}
        self._note_shared()
        if self.folder.is_there:
            self.manifest.end_for_good(self.folder.path, Status.INTERRUPTED)

    def _begin(self) -> None:
        problem, parameters = self.problem, self.folder.parameters
        self._save_checkpoint()
        for view in problem.views:
            self._write_image("target", view.sensor, np.array(view.target))
            if view.weights is not None:
                write_image(self.folder.images / self._image_name("weights", view.sensor), np.array(view.weights))
        self._write_images("initial")
        write_parameters(parameters / "initial", problem.values())
        if problem.truth:
            write_parameters(parameters / "true", problem.truth)
        for key, mask in problem.masks.items():
            write_mask(parameters, key, mask)

    def _iterate(self, stop: Callable[[], bool]) -> Iterator[Record]:
        run, saved, saved_at = self.problem.config.run, self.done, time.monotonic()
        every, told = run.images_every, self.course.state.scaling
        if stop():
            return
        with MetricsWriter(self.folder.path) as metrics:
            for state, record in self._iterations():
                if state.scaling is not None and state.scaling is not told:
                    self._tell_scaling(state.scaling)
                told = state.scaling
                self.course.add(state, record)
                metrics.write(record)
                yield record
                self._note_memory(record.peak_mib)
                if (fault := self.folder.fault) is not None:  # another run's may have taken its name
                    raise fault
                if stop():
                    return
                if every and self.done % every == 0 and self.done < run.iterations:
                    self._write_images(f"iteration-{self.done:06d}")
                if run.checkpoint_every.is_due(self.done - saved, time.monotonic() - saved_at):
                    metrics.sync()  # first: a checkpoint counts on the lines of its iterations
                    self._save_checkpoint()
                    saved, saved_at = self.done, time.monotonic()
                self.page.refresh()

    def _iterations(self) -> Iterator[tuple[State, Record]]:
        course = self.course
        yield from iterate(course.stages, course.state, self._on_nonfinite, watch=course.watch)
        if course.state.stopped:
            logger.info(f"stopped after {self.done} iterations: {course.state.stopped}")

    def _tell_scaling(self, measured: Sequence[Scaled]) -> None:
        """Note what was measured for `scale`, and say what it makes of a step."""
        self.manifest.scaling = [row.to_json() for row in measured]
        for row in measured:
            spec = self.problem.selection.spec(row.key)
            rate = spec.learning_rate or self.problem.config.optimizer.learning_rate
            level = logging.WARNING if row.own_length is None else logging.INFO
            scale = self.problem.config.optimizer.scale
            line = curvature_line(row, rate) if scale == "curvature" else step_line(row, spec.transform, rate)
            logger.log(level, f"scale {scale}: {line}")

    def _note_memory(self, peak: float) -> None:
        """Note the memory that was used, where there is a budget; warn the first time that it is above that."""
        if (plan := self.problem.memory) is not None:
            if (warning := plan.check(peak)) is not None:
                logger.warning(warning)
            self.manifest.memory = plan.to_json()

    def _on_nonfinite(self, found: Findings) -> None:
        """Keep what the first step that met a value that is not finite began with, and say how to look into it."""
        if self._saved_nonfinite:
            return
        stages, state = self.course.stages, self.course.stages.begun
        assert state is not None, "an iteration is at work"
        # What guided emission knew before this iteration, which may have taught it more.
        noted = noted_of(stages.now)
        step = NonFiniteStep(found.iteration, stages.now.values(), state.guiding, state.learned, noted)
        save_nonfinite(self.folder.checkpoint, step)
        self._saved_nonfinite = True
        if self.problem.config.run.on_nonfinite != "stop":  # which says so when it ends
            logger.warning(f"{found}; {self._where()}")

    def _where(self) -> str:
        """How to look into a value that is not finite."""
        if self.problem.config.codes:
            return "look at what your own code returns, which `reslrb inspect --nonfinite` does not run"
        return f"where: reslrb inspect {shlex.quote(os.path.relpath(self.folder.path / 'config.yaml'))} --nonfinite"

    def _end(self, status: Status, failure: BaseException | None) -> Status:
        ending = Ending(self.folder.path, self.manifest, status, failure, self._kept)
        if (fault := self.folder.fault) is not None:
            return ending.give_up(fault)
        ending.part("results", self._note_results)
        ending.part("folder", self.folder.make_whole)
        ending.begin(["checkpoint", "parameters", "final images"])
        ending.part("checkpoint", self._save_last_checkpoint)
        ending.part("parameters", self._write_parameters)
        if failure is None:
            ending.part("final images", self._write_final_images)
            if status is Status.FINISHED:  # who interrupts does not want to wait; `reslrb report` finds them as well
                self._add("how certain the values are was", self._measure_certainty)
                self._add("errors as people see them were", self._measure_seen_errors)
                if self.problem.config.fabrication is not None:
                    self._add("what a maker has to know of the solid was", self._measure_solid)
        else:
            self.manifest.missing["final images"] = "the run failed"
        return ending.finish(self._write_page)

    def _write_parameters(self) -> None:
        """Write the last values, and beside them the best so far, where there are any."""
        if self.course.averages:
            write_parameters(self.folder.parameters / "last", self.course.bring_last().values())
        write_parameters(self.folder.parameters, self.course.bring_result().values())
        best = self.course.best_values()
        if best:
            write_parameters(self.folder.parameters / "best", best)

    def _write_page(self) -> None:
        """Write the page for the last time; where that fails, none is left that says the run is at work."""
        try:
            write_report(self.folder.path)
        except Exception:
            with contextlib.suppress(OSError):
                (self.folder.path / "report.html").unlink(missing_ok=True)
            raise

    def _write_live_page(self) -> None:
        if self.course.last is None:  # nothing is there to be drawn, so that this takes no time
            write_report(self.folder.path, self.manifest.content(), {})
        else:
            found = self._found()
            self._note_shared()
            write_report(self.folder.path, self.manifest.content() | {"results": found}, self.problem.values())

    def _add(self, failed: str, measure: Callable[[], None]) -> None:
        """Add to the results what `measure` finds. The run is what it is without that; `failed` says so."""
        try:
            measure()
        except Exception as error:
            logger.warning("%s not measured: %s", failed, describe(error))
        else:
            self._note_results()

    def _measure_certainty(self) -> None:
        last = self.course.last
        config = self.problem.config
        if last is None or self.done < LEAST_ITERATIONS or not config.run.certainty:
            return
        if self.course.averages:
            logger.info("how certain the values are is not measured of averages")
            return
        if not config.by_pixel:
            logger.info("how certain the values are is not measured: it takes a loss of each pixel by itself")
            return
        logger.info("measuring how certain the values are")
        measured = self.course.certainty.measure(self.done, last.elapsed_s, self._stop)
        self.certainty = measured and measured.without_derivatives(
            [record.parameter for record in incomplete_records(self.manifest.incomplete)]
        )
        for key, shown in self.course.certainty.shown.items():
            if key not in self.problem.masks:  # of which it was found out before
                write_mask(self.folder.parameters, key, shown)

    def _measure_seen_errors(self) -> None:
        pixels = sum(view.target.shape[0] * view.target.shape[1] for view in self.problem.views)
        if pixels > MANY_PIXELS:
            logger.info(f"comparing images of {pixels / 1e6:.2g} million pixels as people see them")
        self.seen = finite(seen_errors(self.folder.path, self.manifest.results, self.manifest.views))

    def _measure_solid(self) -> None:
        from reslrb_cli.runs.export import keep_solid

        view = self.problem.views[0]
        shown = load_image(self.folder.images / f"{self._image_name('final', view.sensor)}.exr")
        if shown is not None:
            logger.info("making the solid")
            problem = self.problem
            keep_solid(
                problem.config, problem.scene, problem.selection.params, view.sensor, self.folder.path, shown,
                np.array(view.target),
            )  # fmt: skip

    def _write_final_images(self) -> None:
        self._write_images("final")
        self._note_results()

    def _note_results(self) -> None:
        self._note_shared()
        self.manifest.results = self._found()

    def _note_shared(self) -> None:
        """Note what workers have done by now."""
        if self.course.shared is not None:
            self.manifest.shared = finite(asdict(self.course.shared))

    def _found(self) -> dict[str, Any]:
        """What the run came to, or has come to by now."""
        last = self.course.last
        found = self._ended()
        if self.manifest.incomplete:
            found["incomplete"] = self.manifest.incomplete
        if self.certainty is not None:
            found["certainty"] = finite(self.certainty.to_json())
        found["warnings"] = warnings({"iterations": self.done, **found})
        return {
            "iterations": self.done,
            "loss": last and finite(last.loss),
            "elapsed_s": last and last.elapsed_s,
            **found,
            "error_maps": self.error_maps,
            **({"seen": self.seen} if self.seen else {}),
            "nonfinite": self.course.nonfinite.to_json(),
            "clamped": self.course.clamped.to_json(),
            **({"regularized": self.course.regularized.to_json()} if self.course.regularized.iterations else {}),
            "best": finite(self.course.best.to_json()),
        }

    def _ended(self) -> dict[str, Any]:
        """The results with the values of the end, and of an average beside them what the last values were."""
        course, results, told = self.course, self.course.results, {}
        if course.averages:
            course.bring_last()
            results.end()
            last, average = results.to_json(), course.average
            told = {"average": {
                "first": average.average_first, "iterations": average.average_count,
                "last": {key: each["final"] for key, each in last["parameters"].items()},
                "last_rmse": {key: each["final"] for key, each in last["parameter_rmse"].items()},
            }}  # fmt: skip
        course.bring_result()
        results.end()
        stopped = {"stopped": course.state.stopped} if course.state.stopped else {}
        return {**results.to_json(), **told, **stopped}

    def _kept(self) -> str:
        """What of the run a reader will find."""
        written = "parameters" not in self.manifest.missing
        return what_is_kept(self.folder, self._saved, self.done, written)

    def _save_last_checkpoint(self) -> None:
        """Keep the state, unless it is there already: the one before it then is an earlier one."""
        if self._saved != self.done or not (self.folder.checkpoint / STATE_FILE).exists():
            self._save_checkpoint()

    def _save_checkpoint(self) -> None:
        self._saved = self.course.save(self.folder.checkpoint)

    def _write_images(self, name: str) -> None:
        spp = saved_spp(self.problem, between=name.startswith("iteration"))
        self.course.bring_result()
        if name == "final":
            logger.info(f"rendering the final image: {spp} spp")
        for view in self.problem.views:
            seen = self.problem.see(view, spp, self.done, "saved image")
            image, exposed, scale = view.exposed(seen)
            self._write_image(name, view.sensor, exposed)
            self.course.results.see(name, view, np.array(seen), scale)
            if name == "final":
                suffix = self._image_name("", view.sensor)
                towards = self.problem.image_gradient(view, image)
                about = write_error_map(self.folder.images, suffix, exposed, np.array(view.target), towards)
                self.error_maps[f"error{suffix}"] = about

    def _write_image(self, name: str, sensor: int, image: np.ndarray[Any, Any]) -> None:
        """Write an image of a sensor, to look at with the exposure that suits its target, whatever is in it."""
        exposure = shown_exposures(self.manifest.views).get(self._image_name("", sensor), 1.0)
        write_image(self.folder.images / self._image_name(name, sensor), image, image * np.float32(exposure))

    def _image_name(self, name: str, sensor: int) -> str:
        return name if len(self.problem.views) == 1 else f"{name}-{sensor}"
